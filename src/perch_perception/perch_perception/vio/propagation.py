"""Propagation of the inertial state and its covariance with IMU steps."""

from __future__ import annotations

import numpy as np
from perch_core import so3
from perch_core.vehicle import GRAVITY

from perch_perception.ukf.config import ImuNoise
from perch_perception.vio import state as at
from perch_perception.vio.preintegration import preintegrate
from perch_perception.vio.state import State

_G = np.array([0.0, 0.0, -GRAVITY])


def propagate(s: State, rows: np.ndarray, imu: ImuNoise) -> None:
    """Propagate the inertial part of a state with IMU steps (m, 9), m > 0; the caller sets its stamp."""
    pre = preintegrate(rows, s.gyro_bias, s.accel_bias)
    T, R = pre.duration, s.R_WB
    p = s.p_WB + s.v_WB * T + 0.5 * _G * T * T + R @ pre.dp
    v = s.v_WB + _G * T + R @ pre.dv
    R_end = R @ pre.dR
    Phi = np.eye(at.INERTIAL_SIZE)
    Phi[at.THETA, at.THETA] = pre.dR.T
    Phi[at.POSITION, at.THETA] = -R @ so3.hat(pre.dp)
    Phi[at.VELOCITY, at.THETA] = -R @ so3.hat(pre.dv)
    Phi[at.POSITION, at.VELOCITY] = T * np.eye(3)
    Phi[at.THETA, 9:15] = pre.J[0:3]
    Phi[at.POSITION, 9:15] = R @ pre.J[3:6]
    Phi[at.VELOCITY, 9:15] = R @ pre.J[6:9]
    G = np.zeros((9, 9))
    G[:3, :3], G[3:6, 3:6], G[6:, 6:] = np.eye(3), R, R
    P, n = s.P, at.INERTIAL_SIZE
    own = Phi @ P[:n, :n] @ Phi.T
    own[:9, :9] += G @ pre.Q @ G.T
    P[:n, :n] = 0.5 * (own + own.T)
    d = np.arange(3)
    P[9 + d, 9 + d] += imu.gyro_bias_walk**2 * T
    P[12 + d, 12 + d] += imu.accel_bias_walk**2 * T
    P[:n, n:] = Phi @ P[:n, n:]
    P[n:, :n] = P[:n, n:].T
    s.p_WB, s.v_WB, s.R_WB, s.w_WB_B = p, v, _orthonormal(R_end), pre.w_end


def _orthonormal(R: np.ndarray) -> np.ndarray:
    """Return the rotation nearest to a matrix that rounding has moved off SO(3): one step of Newton's method."""
    return 1.5 * R - 0.5 * R @ (R.T @ R)
