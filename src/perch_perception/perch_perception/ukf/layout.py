"""Layout of the UKF's nominal and error vectors.

Nominal state (16): p_WB, v_WB, q_WB (xyzw), gyro bias, accelerometer bias.
Error state (15): p, v, theta, b_g, b_a; the attitude error is a right perturbation, R_WB = R_nominal exp(theta).
"""

from __future__ import annotations

POSITION, VELOCITY, QUATERNION = slice(0, 3), slice(3, 6), slice(6, 10)
GYRO_BIAS, ACCEL_BIAS = slice(10, 13), slice(13, 16)
NOMINAL_SIZE = 16

D_POSITION, D_VELOCITY, D_ATTITUDE = slice(0, 3), slice(3, 6), slice(6, 9)
D_GYRO_BIAS, D_ACCEL_BIAS = slice(9, 12), slice(12, 15)
ERROR_SIZE = 15
