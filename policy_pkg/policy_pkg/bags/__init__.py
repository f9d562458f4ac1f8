"""Recording a team's graph to rosbag2 MCAP files and reading such files back, without rclpy."""
