"""The UKF's prediction in plain numpy for all sigma points at once, and the manifold of its states."""

from __future__ import annotations

import numpy as np

from perch_core import so3
from perch_core.vehicle import GRAVITY
from perch_perception.ukf import layout as at
from perch_perception.ukf.unscented import ACCEL, DT, GYRO, UnscentedTransform


def plus(x: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Return a nominal state moved by an error.

    Args:
        x: nominal state, shape (16,).
        error: shape (..., 15).

    Returns:
        Nominal states, shape (..., 16).
    """
    error = np.asarray(error, float)
    out = np.empty(error.shape[:-1] + (at.NOMINAL_SIZE,))
    out[..., at.POSITION] = x[at.POSITION] + error[..., at.D_POSITION]
    out[..., at.VELOCITY] = x[at.VELOCITY] + error[..., at.D_VELOCITY]
    q = so3.quat_multiply(x[at.QUATERNION], so3.quat_exp(error[..., at.D_ATTITUDE]))
    out[..., at.QUATERNION] = q / np.linalg.norm(q, axis=-1, keepdims=True)
    out[..., 10:16] = x[10:16] + error[..., 9:15]
    return out


def minus(y: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return the error that moves nominal state x (16,) to y (..., 16), shape (..., 15): `plus(x, minus(y, x)) = y`."""
    out = np.empty(y.shape[:-1] + (at.ERROR_SIZE,))
    out[..., at.D_POSITION] = y[..., at.POSITION] - x[at.POSITION]
    out[..., at.D_VELOCITY] = y[..., at.VELOCITY] - x[at.VELOCITY]
    out[..., at.D_ATTITUDE] = so3.quat_log(so3.quat_multiply(so3.quat_conjugate(x[at.QUATERNION]), y[..., at.QUATERNION]))
    out[..., 9:15] = y[..., 10:16] - x[10:16]
    return out


def predicted(transform: UnscentedTransform, x: np.ndarray, P: np.ndarray, run: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean (16,) and covariance (15, 15) after a run of IMU steps (m, 9), without process noise."""
    root = np.linalg.cholesky(transform.scale * P).T
    points = plus(x, np.vstack([np.zeros(at.ERROR_SIZE), root, -root]))
    gravity = np.array([0.0, 0.0, GRAVITY])
    p, v, q = points[:, at.POSITION], points[:, at.VELOCITY], points[:, at.QUATERNION]
    for row in run:
        dt = row[DT]
        half = so3.quat_exp((row[GYRO] - points[:, at.GYRO_BIAS]) * (0.5 * dt))
        middle = so3.quat_multiply(q, half)
        a_W = so3.quat_rotate(middle, row[ACCEL] - points[:, at.ACCEL_BIAS]) - gravity
        p = p + (v + 0.5 * dt * a_W) * dt
        v = v + a_W * dt
        q = so3.quat_multiply(middle, half)
    points[:, at.POSITION], points[:, at.VELOCITY], points[:, at.QUATERNION] = p, v, q
    deviations = minus(points, points[0])
    mean = transform.Wm @ deviations
    centred = deviations - mean
    return plus(points[0], mean), (centred * transform.Wc[:, None]).T @ centred
