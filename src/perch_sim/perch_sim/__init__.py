"""The simulated vehicle: plant, rotors, IMU, cameras, contact and timing."""
