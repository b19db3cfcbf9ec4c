"""Control period, shared by simulated IMU, estimator and controller: 500 Hz."""

CONTROL_PERIOD_NS = 2_000_000
CONTROL_PERIOD = 0.002  # [s]
