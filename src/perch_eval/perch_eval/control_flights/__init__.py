"""Flights that evaluate the controller: under faults, cancelled, and with the control laws compared. No ROS."""
