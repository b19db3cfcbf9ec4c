"""The parts of perch_eval that need ROS: message definitions, recorder, viewer, recorded flights, action client."""
