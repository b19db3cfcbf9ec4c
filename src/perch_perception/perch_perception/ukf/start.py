"""The filter's first belief: attitude from gravity before VIO speaks, then VIO's first pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from perch_core import so3
from perch_core.vehicle import GRAVITY
from perch_perception.ukf import drift
from perch_perception.ukf import layout as at
from perch_perception.ukf.config import UkfConfig
from perch_perception.ukf.measurement import VioPose
from perch_perception.ukf.unscented import ACCEL, GYRO, Belief

UNKNOWN_POSITION, UNKNOWN_VELOCITY, UNKNOWN_YAW = 1e3, 1e2, np.pi  # 1 sigma before the first VIO pose [m, m/s, rad]


@dataclass(frozen=True)
class Rest:
    """What the IMU says while it may be standing still: whether it is, mean gyro [rad/s], mean accel [m/s^2], samples."""

    at_rest: bool
    gyro: np.ndarray
    accel: np.ndarray
    samples: int


def look_for_rest(config: UkfConfig, steps: np.ndarray) -> Rest:
    """Whether IMU steps (m, 9) look like standing still: mean rate near zero, mean force near gravity."""
    if len(steps) == 0:
        return Rest(False, np.zeros(3), np.zeros(3), 0)
    gyro, accel = steps[:, GYRO].mean(axis=0), steps[:, ACCEL].mean(axis=0)
    long_enough = steps[:, 0].sum() >= 0.9 * config.rest_time
    still = np.linalg.norm(gyro) < config.rest_gyro and abs(np.linalg.norm(accel) - GRAVITY) < config.rest_accel
    return Rest(bool(long_enough and still), gyro, accel, len(steps))


def level(accel: np.ndarray) -> np.ndarray:
    """Quaternion xyzw with yaw 0 whose z axis lies along the specific force (3,), shape (4,)."""
    norm = np.linalg.norm(accel)
    if norm < 1e-6:
        return np.array([0.0, 0.0, 0.0, 1.0])
    z_W_B = accel / norm  # W's z axis in B
    q = np.array([z_W_B[1], -z_W_B[0], 0.0, 1.0 + z_W_B[2]])
    if np.linalg.norm(q) < 1e-6:  # upside down
        return np.array([1.0, 0.0, 0.0, 0.0])
    return q / np.linalg.norm(q)


def before_vio(stamp: int, accel: np.ndarray) -> Belief:
    """Belief without any VIO pose: level by gravity, everything else unknown."""
    x = np.zeros(at.NOMINAL_SIZE)
    x[at.QUATERNION] = level(accel)
    tilt = 0.1
    sigma = np.repeat([UNKNOWN_POSITION, UNKNOWN_VELOCITY, tilt, 0.1, 0.5, UNKNOWN_POSITION, UNKNOWN_YAW], 3)
    P = np.diag(sigma**2)
    R_BW = so3.quat_to_matrix(x[at.QUATERNION]).T
    P[at.D_ATTITUDE, at.D_ATTITUDE] += UNKNOWN_YAW**2 * np.outer(R_BW[:, 2], R_BW[:, 2])
    return Belief(stamp, x, P)


def from_vio(config: UkfConfig, pose: VioPose, steps: np.ndarray) -> Belief:
    """Belief at VIO's first pose.

    At rest the gyro's mean is its bias, and the accelerometer's is what gravity leaves. The vehicle's pose error and VIO's drift are then opposite and fully
    correlated: p = z - d - n.

    Args:
        config: the filter's settings.
        pose: VIO's pose; its velocity is taken where it has one.
        steps: IMU steps before the pose, shape (m, 9).
    """
    rest = look_for_rest(config, steps)
    moving = pose.v_WB is not None and np.linalg.norm(pose.v_WB) > 0.1
    at_rest = rest.at_rest and not moving
    x = np.zeros(at.NOMINAL_SIZE)
    x[at.POSITION], x[at.QUATERNION] = pose.p_WB, pose.q_WB
    if pose.v_WB is not None:
        x[at.VELOCITY] = pose.v_WB
    P = np.zeros((at.ERROR_SIZE, at.ERROR_SIZE))
    C = pose.covariance + drift.least_growth(config.vio, 1.0)
    J = np.zeros((6, 6))
    J[:3, :3], J[3:, 3:] = np.eye(3), so3.quat_to_matrix(pose.q_WB).T
    pose_rows = np.ix_(np.r_[0:3, 6:9], np.r_[0:3, 6:9])
    P[pose_rows] = J @ (C + drift.white(config.vio)) @ J.T
    P[np.ix_(np.r_[0:3, 6:9], np.r_[15:21])] = -J @ C
    P[np.ix_(np.r_[15:21], np.r_[0:3, 6:9])] = -C @ J.T
    P[at.D_DRIFT, at.D_DRIFT] = C
    velocity_sigma = 0.02 if at_rest else (0.1 if pose.v_WB is not None else 2.0)
    P[at.D_VELOCITY, at.D_VELOCITY] = np.eye(3) * velocity_sigma**2
    gyro_sigma = config.imu.gyro_bias_init
    if at_rest:
        x[at.GYRO_BIAS] = rest.gyro
        gyro_sigma = max(config.imu.gyro_noise / np.sqrt(rest.samples), 1e-4)
    P[at.D_GYRO_BIAS, at.D_GYRO_BIAS] = np.eye(3) * gyro_sigma**2
    P[at.D_ACCEL_BIAS, at.D_ACCEL_BIAS] = np.eye(3) * config.imu.accel_bias_init**2
    if at_rest:
        _weigh(config, x, P, rest)
    return Belief(pose.stamp, x, P)


def _weigh(config: UkfConfig, x: np.ndarray, P: np.ndarray, rest: Rest) -> None:
    """Tilt and accelerometer bias at rest hang together, whoever found the tilt: mean f = R^T g + b_a + n, so that
    b_a = f - R^T g with the error -[R^T g]x theta - n."""
    up_B = so3.quat_to_matrix(x[at.QUATERNION]).T @ np.array([0.0, 0.0, GRAVITY])
    by_tilt = -so3.hat(up_B)
    x[at.ACCEL_BIAS] = rest.accel - up_B
    P[at.D_ACCEL_BIAS, :] = by_tilt @ P[at.D_ATTITUDE, :]
    P[:, at.D_ACCEL_BIAS] = P[at.D_ACCEL_BIAS, :].T
    P[at.D_ACCEL_BIAS, at.D_ACCEL_BIAS] = (by_tilt @ P[at.D_ATTITUDE, at.D_ATTITUDE] @ by_tilt.T
                                           + config.imu.accel_noise**2 / rest.samples * np.eye(3))
