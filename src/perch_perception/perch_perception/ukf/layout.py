"""Layout of the UKF's nominal and error vectors; addition of errors to nominal states, and differences of these.

Nominal state (16): p_WB, v_WB, q_WB (xyzw), gyro bias, accelerometer bias.
Error state (15): p, v, theta, b_g, b_a; the attitude error is a right perturbation, R_WB = R_nominal exp(theta).
"""

from __future__ import annotations

import numpy as np

from perch_core import so3

POSITION, VELOCITY, QUATERNION = slice(0, 3), slice(3, 6), slice(6, 10)
GYRO_BIAS, ACCEL_BIAS = slice(10, 13), slice(13, 16)
NOMINAL_SIZE = 16

D_POSITION, D_VELOCITY, D_ATTITUDE = slice(0, 3), slice(3, 6), slice(6, 9)
D_GYRO_BIAS, D_ACCEL_BIAS = slice(9, 12), slice(12, 15)
ERROR_SIZE = 15


def plus(x: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Return a nominal state moved by an error.

    Args:
        x: nominal state, shape (16,).
        error: shape (..., 15).

    Returns:
        Nominal states, shape (..., 16).
    """
    error = np.asarray(error, float)
    out = np.empty(error.shape[:-1] + (NOMINAL_SIZE,))
    out[..., POSITION] = x[POSITION] + error[..., D_POSITION]
    out[..., VELOCITY] = x[VELOCITY] + error[..., D_VELOCITY]
    q = so3.quat_multiply(x[QUATERNION], so3.quat_exp(error[..., D_ATTITUDE]))
    out[..., QUATERNION] = q / np.linalg.norm(q, axis=-1, keepdims=True)
    out[..., 10:16] = x[10:16] + error[..., 9:15]
    return out


def minus(y: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return the error that moves nominal state x (16,) to y (..., 16), shape (..., 15): `plus(x, minus(y, x)) = y`."""
    out = np.empty(y.shape[:-1] + (ERROR_SIZE,))
    out[..., D_POSITION] = y[..., POSITION] - x[POSITION]
    out[..., D_VELOCITY] = y[..., VELOCITY] - x[VELOCITY]
    out[..., D_ATTITUDE] = so3.quat_log(so3.quat_multiply(so3.quat_conjugate(x[QUATERNION]), y[..., QUATERNION]))
    out[..., 9:15] = y[..., 10:16] - x[10:16]
    return out
