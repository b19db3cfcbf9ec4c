"""Maths, models and ROS conventions shared by every perch package."""
