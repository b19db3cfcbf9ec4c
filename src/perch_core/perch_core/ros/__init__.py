"""Shared parts of all nodes: parameters, QoS, conversions, arrival host and main loop. The only ROS code in perch_core."""
