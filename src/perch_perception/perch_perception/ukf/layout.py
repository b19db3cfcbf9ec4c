"""Where each quantity sits in the UKF's nominal and error vectors, and how an error is put onto a nominal state.

Nominal state (22): p_WB, v_WB, q_WB (xyzw), gyro bias, accelerometer bias, VIO drift (position, attitude).
Error state (21): p, v, theta, b_g, b_a, drift p, drift theta. The first 15 are the vehicle's; the attitude error
is a right perturbation, R_WB = R_nominal exp(theta). The six drift states model what VIO's error does in time
(`drift.py`): they exist so that the 15 have an honest covariance. The drift's attitude is a left perturbation,
because VIO drifts about the vertical of W: R_VIO = exp(drift) R_WB.
"""

from __future__ import annotations

import numpy as np

from perch_core import so3

POSITION, VELOCITY, QUATERNION = slice(0, 3), slice(3, 6), slice(6, 10)
GYRO_BIAS, ACCEL_BIAS, DRIFT = slice(10, 13), slice(13, 16), slice(16, 22)
NOMINAL_SIZE = 22

D_POSITION, D_VELOCITY, D_ATTITUDE = slice(0, 3), slice(3, 6), slice(6, 9)
D_GYRO_BIAS, D_ACCEL_BIAS, BIASES = slice(9, 12), slice(12, 15), slice(9, 15)
D_DRIFT, D_DRIFT_POSITION, D_DRIFT_ATTITUDE = slice(15, 21), slice(15, 18), slice(18, 21)
VEHICLE_SIZE, ERROR_SIZE = 15, 21


def plus(x: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Nominal state moved by an error.

    Args:
        x: nominal state, shape (22,).
        error: shape (..., 21).

    Returns:
        Nominal states, shape (..., 22).
    """
    error = np.asarray(error, float)
    out = np.empty(error.shape[:-1] + (NOMINAL_SIZE,))
    out[..., POSITION] = x[POSITION] + error[..., D_POSITION]
    out[..., VELOCITY] = x[VELOCITY] + error[..., D_VELOCITY]
    q = so3.quat_multiply(x[QUATERNION], so3.quat_exp(error[..., D_ATTITUDE]))
    out[..., QUATERNION] = q / np.linalg.norm(q, axis=-1, keepdims=True)
    out[..., 10:16] = x[10:16] + error[..., 9:15]
    out[..., DRIFT] = x[DRIFT] + error[..., D_DRIFT]
    return out


def minus(y: np.ndarray, x: np.ndarray) -> np.ndarray:
    """The error that takes nominal state x (22,) to y (..., 22), shape (..., 21): `plus(x, minus(y, x)) = y`."""
    out = np.empty(y.shape[:-1] + (ERROR_SIZE,))
    out[..., D_POSITION] = y[..., POSITION] - x[POSITION]
    out[..., D_VELOCITY] = y[..., VELOCITY] - x[VELOCITY]
    out[..., D_ATTITUDE] = so3.quat_log(so3.quat_multiply(so3.quat_conjugate(x[QUATERNION]), y[..., QUATERNION]))
    out[..., 9:15] = y[..., 10:16] - x[10:16]
    out[..., D_DRIFT] = y[..., DRIFT] - x[DRIFT]
    return out
