"""What every node shares: parameters, QoS, conversions, lockstep, and the main loop. The only ROS code in perch_core."""
