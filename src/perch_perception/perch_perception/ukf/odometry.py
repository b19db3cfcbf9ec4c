"""Conversion of states to the covariances of nav_msgs/Odometry, and of VIO's messages to `VioPose`."""

from __future__ import annotations

import numpy as np

from perch_core import so3
from perch_core.errors import PerchError
from perch_core.jit import compiled
from perch_core.values import InertialState, OdometryState
from perch_perception.ukf.measurement import Inertial, VioPose


def covariances(R_WB: np.ndarray, v_WB: np.ndarray, P: np.ndarray, gyro_noise: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Return pose and twist covariance of an inertial state.

    Args:
        R_WB: its attitude, shape (3, 3).
        v_WB: its velocity [m/s], shape (3,).
        P: covariance of (p, v, theta, b_g, b_a), theta a rotation vector in B, shape (15, 15).
        gyro_noise: 1 sigma of one gyro sample [rad/s].

    Returns:
        pose: covariance of (position in W, rotation about W's axes), shape (6, 6).
        twist: covariance of (velocity in B, angular velocity in B), shape (6, 6).
    """
    return _covariances(R_WB, so3.hat(R_WB.T @ v_WB), np.ascontiguousarray(P), gyro_noise)


@compiled
def _covariances(R_WB, hat_v_B, P, gyro_noise):
    """Compute `covariances` from R_WB and [v_B]x, both (3, 3), and P (15, 15)."""
    pose_map = np.zeros((6, 15))  # indices: `layout`
    pose_map[:3, 0:3] = np.eye(3)
    pose_map[3:, 6:9] = R_WB
    # v_B = R^T v: an attitude error exp(theta) turns the velocity by v_B x theta
    twist_map = np.zeros((6, 15))
    twist_map[:3, 3:6] = R_WB.T
    twist_map[:3, 6:9] = hat_v_B
    twist_map[3:, 9:12] = -np.eye(3)
    twist = twist_map @ P @ twist_map.T
    for i in range(3, 6):
        twist[i, i] += gyro_noise**2
    return pose_map @ P @ pose_map.T, twist


def vio_state(stamp: int, p_WB: np.ndarray, q_WB: np.ndarray, v_WB: np.ndarray, inertial: Inertial) -> VioPose:
    """Return VIO's full state as a `VioPose`.

    Args:
        stamp, p_WB, q_WB, inertial: as in `VioPose`.
        v_WB: velocity in W [m/s], shape (3,).
    """
    R_WB = so3.quat_to_matrix(q_WB)
    pose, twist = covariances(R_WB, v_WB, inertial.P)
    return VioPose(stamp, p_WB, q_WB, pose, R_WB.T @ v_WB, twist[:3, :3], inertial)


def pose_of(odometry: OdometryState) -> VioPose:
    """Return the VIO pose in a value of `vio/odometry`.

    Raises:
        PerchError: an array is not of the shape that the value names.
    """
    p, q, v_B, _ = (_numbers(x, n) for x, n in ((odometry.p_WB, 3), (odometry.q_WB, 4), (odometry.v_B, 3), (odometry.w_B, 3)))
    covariance, twist = _numbers(odometry.pose_covariance, 6, 6), _numbers(odometry.twist_covariance, 6, 6)
    if not odometry.has_twist:
        return VioPose(odometry.stamp, p, q, covariance)
    # all zero: its covariance is not given
    return VioPose(odometry.stamp, p, q, covariance, v_B, twist[:3, :3] if twist[0, 0] > 0.0 else None)


def state_of(state: InertialState) -> VioPose:
    """Return the VIO pose in a value of `vio/state`.

    Raises:
        PerchError: an array is not of the shape that the value names.
    """
    inertial = Inertial(_numbers(state.gyro_bias, 3), _numbers(state.accel_bias, 3), _numbers(state.covariance, 15, 15))
    return vio_state(state.stamp, _numbers(state.p_WB, 3), _numbers(state.q_WB, 4), _numbers(state.v_WB, 3), inertial)


def _numbers(values: object, *shape: int) -> np.ndarray:
    array = np.asarray(values, dtype=float)
    if array.shape != shape:
        raise PerchError(f"shape {array.shape} is not {shape}")
    return array
