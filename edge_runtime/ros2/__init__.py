"""ROS 2 on Zenoh without ROS 2: messages in CDR, and the names of zenoh-bridge-ros2dds."""
