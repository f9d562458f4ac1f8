"""Decentralised QMIX agents: acting (numpy), training (torch, under learner/), and ROS 2 nodes."""

from policy_pkg.kernels import pin_kernels

pin_kernels()
