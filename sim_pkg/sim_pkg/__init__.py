"""Multi-robot simulator on pymunk: scenarios, a batch of arenas, and its ROS 2 node."""
