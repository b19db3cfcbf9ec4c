"""To and from the axes of nav_msgs/Odometry: a state's covariances, VIO's pose."""

from __future__ import annotations

import numpy as np

from perch_core import so3
from perch_core.jit import compiled
from perch_perception.ukf.measurement import Inertial, VioPose


def covariances(R_WB: np.ndarray, v_WB: np.ndarray, P: np.ndarray, gyro_noise: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Pose and twist covariance of an inertial state.

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
    """`covariances` of P (15, 15), with R_WB and [v_B]x (3, 3)."""
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


def vio_pose(stamp: int, p_WB: np.ndarray, q_WB: np.ndarray, covariance: np.ndarray, v_WB: np.ndarray | None,
             velocity_covariance_B: np.ndarray | None) -> VioPose:
    """VIO's pose as the estimator takes it.

    Args:
        stamp, p_WB, q_WB, covariance, v_WB: as in `VioPose`.
        velocity_covariance_B: of the velocity in B, shape (3, 3), or None.
    """
    if velocity_covariance_B is None:
        return VioPose(stamp, p_WB, q_WB, covariance, v_WB)
    R_WB = so3.quat_to_matrix(q_WB)
    return VioPose(stamp, p_WB, q_WB, covariance, v_WB, R_WB @ velocity_covariance_B @ R_WB.T)


def vio_state(stamp: int, p_WB: np.ndarray, q_WB: np.ndarray, v_WB: np.ndarray, inertial: Inertial) -> VioPose:
    """VIO's whole state as the estimator takes it; arguments as in `VioPose`."""
    R_WB = so3.quat_to_matrix(q_WB)
    pose, twist = covariances(R_WB, v_WB, inertial.P)
    return VioPose(stamp, p_WB, q_WB, pose, v_WB, R_WB @ twist[:3, :3] @ R_WB.T, inertial)
