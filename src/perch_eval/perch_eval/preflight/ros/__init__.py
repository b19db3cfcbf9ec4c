"""ROS side of the preflight check."""
