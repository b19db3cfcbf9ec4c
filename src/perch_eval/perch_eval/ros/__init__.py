"""What perch_eval needs of ROS: message definitions, recorder and viewer, the recorded flight, the action client."""
