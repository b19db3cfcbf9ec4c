"""Section IV-C of paper M as it is printed, to be read beside it. What flies is `perch_planner.planner`."""
