"""Section IV-C of paper M as printed, for comparison with the text. The shipped planner is `perch_planner.planner`."""
