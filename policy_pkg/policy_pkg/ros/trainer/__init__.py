"""Training over ROS: the graph plays, the trainer learns."""
