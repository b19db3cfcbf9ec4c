"""Target localisation, visual-inertial odometry, state estimation and powerline mapping."""
