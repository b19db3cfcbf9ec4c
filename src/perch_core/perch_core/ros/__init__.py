"""What every node shares: parameters, QoS, conversions, the arrival host, and the main loop. The only ROS code in perch_core."""
