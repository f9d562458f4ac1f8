"""Decentralised QMIX agents: acting (numpy), training (torch, under train/), and ROS 2 nodes."""
