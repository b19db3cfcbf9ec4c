"""The period that simulated IMU, estimator and controller share, 500 Hz, and the ticks of what decides at 50 Hz."""

CONTROL_PERIOD_NS = 2_000_000
CONTROL_PERIOD = 0.002  # [s]
TICK_STEPS = 10         # `tick` repeats every tenth step, for nodes that need no more
