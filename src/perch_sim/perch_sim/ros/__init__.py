"""Lockstep over ROS: the vehicle's node, which owns the schedule, and the node of every participant."""
