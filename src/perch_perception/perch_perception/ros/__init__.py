"""ROS code that several nodes of perch_perception share."""
