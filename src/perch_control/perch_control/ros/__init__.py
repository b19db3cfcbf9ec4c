"""ROS parts that more than one file of the nodes needs."""
