"""What perch_eval needs of ROS: message types and definitions, the recorded flight, the action client."""
