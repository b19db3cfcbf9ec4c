"""Updates of the UKF at rest: constant pose, zero velocity, observed biases.

While the vehicle rests, the IMU is not an input of the motion model but a measurement: the pose is constant, the biases walk, and

    0 = v + n_v,    w_mean = b_g + n_w,    f_mean = b_a + R^T g + n_f.

Position and heading therefore stay as certain as they were when the rest began. [OpenVINS: zero-velocity update]
"""

from __future__ import annotations

import numpy as np

from perch_core import so3
from perch_core.vehicle import GRAVITY
from perch_perception.ukf import layout as at
from perch_perception.ukf.config import UkfConfig
from perch_perception.ukf.imu_buffer import without_gaps
from perch_perception.ukf.stillness import REST_VELOCITY
from perch_perception.ukf.unscented import ACCEL, DT, GATES, GYRO, Belief, Innovation, UnscentedTransform


def after_stop(belief: Belief) -> Belief | None:
    """Return the belief after a first zero-velocity update; None where its velocity is not consistent with zero."""
    H = np.zeros((3, at.ERROR_SIZE))
    H[:, at.D_VELOCITY] = np.eye(3)
    innovation = _innovation(belief, H, -belief.x[at.VELOCITY], np.full(3, REST_VELOCITY**2))
    return UnscentedTransform.correct(belief, innovation) if innovation.nis < GATES[3] else None


def after_rest(belief: Belief, steps: np.ndarray, stamp: int, config: UkfConfig) -> Belief:
    """Return the belief of a vehicle at rest over IMU steps (m, 9), m > 0, at their end `stamp` [ns].

    Over a gap in the samples it rests unmeasured: only the biases walk.
    """
    imu, x, P = config.imu, belief.x.copy(), belief.P.copy()
    T, steps, d = float(steps[:, DT].sum()), without_gaps(steps), np.arange(3)
    x[at.VELOCITY] = 0.0
    P[at.D_VELOCITY, :] = P[:, at.D_VELOCITY] = 0.0
    P[at.D_VELOCITY, at.D_VELOCITY] = REST_VELOCITY**2 * np.eye(3)  # how it trembles now says nothing of then
    P[9 + d, 9 + d] += imu.gyro_bias_walk**2 * T
    P[12 + d, 12 + d] += imu.accel_bias_walk**2 * T
    resting = Belief(stamp, x, P)
    if not len(steps):
        return resting
    up_B = so3.quat_rotate(so3.quat_conjugate(x[at.QUATERNION]), np.array([0.0, 0.0, GRAVITY]))
    H = np.zeros((6, at.ERROR_SIZE))
    H[:3, at.D_GYRO_BIAS] = H[3:, at.D_ACCEL_BIAS] = np.eye(3)
    H[3:, at.D_ATTITUDE] = so3.hat(up_B)
    residual = np.concatenate([steps[:, GYRO].mean(axis=0) - x[at.GYRO_BIAS], steps[:, ACCEL].mean(axis=0) - x[at.ACCEL_BIAS] - up_B])
    variance = np.repeat([imu.gyro_noise_density**2, imu.accel_noise_density**2], 3) / float(steps[:, DT].sum())
    return UnscentedTransform.correct(resting, _innovation(resting, H, residual, variance))


def _innovation(belief: Belief, H: np.ndarray, residual: np.ndarray, variance: np.ndarray) -> Innovation:
    S = H @ belief.P @ H.T + np.diag(variance)
    gain = np.linalg.solve(S, H @ belief.P).T
    return Innovation(residual, S, np.ascontiguousarray(gain), float(residual @ np.linalg.solve(S, residual)))
