"""Flights that show what the controller does: under faults, and one law against the other. No ROS."""
