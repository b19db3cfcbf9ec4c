"""IMU steps between two frames, integrated once: motion, its derivatives by the biases, and the noise it gathers.

Forster et al., On-Manifold Preintegration: with R, v, p at the start,
    R' = R dR,   v' = v + g T + R dv,   p' = p + v T + g T^2/2 + R dp.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from perch_perception.ukf.compiled import compiled


@dataclass(frozen=True)
class Preintegration:
    """Motion over T relative to the start, free of gravity and initial velocity.

    Attributes:
        duration: T [s].
        dR: shape (3, 3); dv [m/s], dp [m]: shape (3,), in the axes of B at the start.
        J: derivative of (log dR (right), dp, dv) by (b_g, b_a), shape (9, 6).
        Q: covariance of the same from IMU noise, shape (9, 9).
        w_end: angular velocity of the last step, bias removed [rad/s], shape (3,).
    """

    duration: float
    dR: np.ndarray
    dv: np.ndarray
    dp: np.ndarray
    J: np.ndarray
    Q: np.ndarray
    w_end: np.ndarray


@compiled
def _rotation(v):
    """exp of a rotation vector and its right Jacobian."""
    a2 = v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
    a = np.sqrt(a2)
    if a < 1e-4:
        s, c, d = 1.0 - a2 / 6.0, 0.5 - a2 / 24.0, 1.0 / 6.0 - a2 / 120.0
    else:
        s, c, d = np.sin(a) / a, (1.0 - np.cos(a)) / a2, (a - np.sin(a)) / (a2 * a)
    K = np.zeros((3, 3))
    K[0, 1], K[0, 2], K[1, 2] = -v[2], v[1], -v[0]
    K[1, 0], K[2, 0], K[2, 1] = v[2], -v[1], v[0]
    K2 = K @ K
    eye = np.eye(3)
    return eye + s * K + c * K2, eye - c * K + d * K2


@compiled
def _integrate(rows, bg, ba, dR, dp, dv, J, Q):
    """Accumulate rows (dt, gyro, accel, gyro variance, accel variance) into the outputs; returns the duration."""
    F = np.eye(9)
    skew = np.zeros((3, 3))
    T = 0.0
    for k in range(rows.shape[0]):
        dt = rows[k, 0]
        w = rows[k, 1:4] - bg
        a = rows[k, 4:7] - ba
        half, half_right = _rotation(w * (0.5 * dt))
        full, right = _rotation(w * dt)
        M = dR @ half  # attitude at the middle of the step
        f = M @ a
        skew[0, 1], skew[0, 2], skew[1, 2] = -a[2], a[1], -a[0]
        skew[1, 0], skew[2, 0], skew[2, 1] = a[2], -a[1], a[0]
        # errors (theta, p, v): the attitude error at the middle is that at the start, turned by half the step
        A = -(M @ skew @ half.T) * dt
        F[0:3, 0:3] = full.T
        F[3:6, 0:3] = A * (0.5 * dt)
        F[6:9, 0:3] = A
        for i in range(3):
            F[3 + i, 6 + i] = dt
        J[:, :] = F @ J
        Q[:, :] = F @ Q @ F.T
        J[0:3, 0:3] -= right * dt
        J[3:6, 3:6] -= M * (0.5 * dt * dt)
        J[6:9, 3:6] -= M * dt
        # the bias also turns the middle of this step itself
        turned = (M @ skew @ half_right) * (0.5 * dt * dt)
        J[3:6, 0:3] += turned * (0.5 * dt)
        J[6:9, 0:3] += turned
        gyro, accel = rows[k, 7] * dt * dt, rows[k, 8] * dt * dt
        for i in range(3):
            Q[i, i] += gyro
            Q[3 + i, 3 + i] += 0.25 * accel * dt * dt
            Q[6 + i, 6 + i] += accel
            Q[3 + i, 6 + i] += 0.5 * accel * dt
            Q[6 + i, 3 + i] += 0.5 * accel * dt
        dp += dv * dt + f * (0.5 * dt * dt)
        dv += f * dt
        dR[:, :] = dR @ full
        T += dt
    return T


def preintegrate(rows: np.ndarray, gyro_bias: np.ndarray, accel_bias: np.ndarray) -> Preintegration:
    """Integrate IMU steps (`ImuBuffer.run`, shape (m, 9)) with given biases (3,)."""
    dR, dp, dv, J, Q = np.eye(3), np.zeros(3), np.zeros(3), np.zeros((9, 6)), np.zeros((9, 9))
    T = _integrate(np.ascontiguousarray(rows), gyro_bias, accel_bias, dR, dp, dv, J, Q)
    w_end = rows[-1, 1:4] - gyro_bias if len(rows) else np.zeros(3)
    return Preintegration(float(T), dR, dv, dp, J, Q, w_end)
