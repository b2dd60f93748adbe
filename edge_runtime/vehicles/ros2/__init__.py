"""A vehicle behind a ROS 2 driver of its own: standard messages on Zenoh. See README.md."""
