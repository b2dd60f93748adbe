"""What is on our wire, as ROS 2 messages."""
