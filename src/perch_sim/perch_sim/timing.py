"""The period that simulated IMU, estimator and controller share, 500 Hz."""

CONTROL_PERIOD_NS = 2_000_000
CONTROL_PERIOD = 0.002  # [s]
