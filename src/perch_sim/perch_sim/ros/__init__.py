"""ROS code of the vehicle that is more than a node's thin shell: its publishers, and the lockstep among processes."""
