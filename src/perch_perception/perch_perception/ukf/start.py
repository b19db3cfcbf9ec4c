"""Initial belief of the filter, from VIO's first pose or its full state."""

from __future__ import annotations

import numpy as np

from perch_core import so3
from perch_perception.ukf import layout as at
from perch_perception.ukf.config import UkfConfig, VioNoise
from perch_perception.ukf.measurement import Inertial, VioPose
from perch_perception.ukf.rest import after_rest
from perch_perception.ukf.stillness import is_at_rest
from perch_perception.ukf.unscented import Belief

_MIN_VARIANCE = 1e-12  # variance that a state has at least, in each direction: a covariance may be singular, a factor's may not
_MAX_REST_SPEED = 0.02  # largest speed at rest [m/s]


def added_noise(noise: VioNoise) -> np.ndarray:
    """Return the noise that is added to the covariance of a pose, shape (6, 6)."""
    return np.diag(np.repeat([noise.position**2, noise.attitude**2], 3))


def from_state(pose: VioPose, known: Inertial) -> Belief:
    """Return VIO's full state as a belief, which replaces that of this filter.

    VIO integrates the same IMU samples as this filter, and uses images in addition. Its state at an exposure is therefore this
    filter's belief after one more measurement, and a fusion of both cannot be better. x := x_VIO, P := P_VIO + `_MIN_VARIANCE` I.
    """
    x = np.zeros(at.NOMINAL_SIZE)
    x[at.POSITION], x[at.QUATERNION] = pose.p_WB, pose.q_WB
    assert pose.v_B is not None  # it comes with the rest
    x[at.VELOCITY] = so3.quat_to_matrix(pose.q_WB) @ pose.v_B
    x[at.GYRO_BIAS], x[at.ACCEL_BIAS] = known.gyro_bias, known.accel_bias
    return Belief(pose.stamp, x, known.P + _MIN_VARIANCE * np.eye(at.ERROR_SIZE))


def from_pose(config: UkfConfig, pose: VioPose, steps: np.ndarray) -> Belief:
    """Return the belief at a first pose.

    At rest, the mean gyro reading gives the gyro's bias, and the mean specific force less gravity the accelerometer's.

    Args:
        config: the filter's settings.
        pose: VIO's pose; its velocity is used where given.
        steps: IMU steps before the pose, shape (m, 9).
    """
    at_rest = is_at_rest(steps) and (pose.v_B is None or np.linalg.norm(pose.v_B) < _MAX_REST_SPEED)
    R_WB = so3.quat_to_matrix(pose.q_WB)
    x = np.zeros(at.NOMINAL_SIZE)
    x[at.POSITION], x[at.QUATERNION] = pose.p_WB, pose.q_WB
    if pose.v_B is not None:
        x[at.VELOCITY] = R_WB @ pose.v_B
    P = np.zeros((at.ERROR_SIZE, at.ERROR_SIZE))
    J = np.zeros((at.ERROR_SIZE, 6))
    J[at.D_POSITION, :3], J[at.D_ATTITUDE, 3:] = np.eye(3), R_WB.T
    P += J @ (pose.covariance + added_noise(config.vio)) @ J.T
    sigma = np.repeat([2.0, config.imu.gyro_bias_init, config.imu.accel_bias_init], 3)
    for block, variance in zip((at.D_VELOCITY, at.D_GYRO_BIAS, at.D_ACCEL_BIAS), np.split(sigma**2, 3)):
        P[block, block] = np.diag(variance)
    belief = Belief(pose.stamp, x, P)
    return after_rest(belief, steps, pose.stamp, config) if at_rest else belief
