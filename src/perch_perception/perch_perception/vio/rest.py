"""The MSCKF at rest, as the UKF is (`perch_perception.ukf.rest`): pose constant, velocity zero, biases seen directly.

On the ground, on a wall and on a wire the downward camera looks at a few square centimetres from 2-5 cm, or into the dark. Nothing
can be triangulated there, but nothing moves either. How rest is recognised: `perch_perception.ukf.stillness`.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from perch_core import so3
from perch_core.probability import chi2_quantile
from perch_core.vehicle import GRAVITY

from perch_perception.ukf.stillness import REST_VELOCITY
from perch_perception.ukf.unscented import ACCEL, ACCEL_VARIANCE, DT, GYRO, GYRO_VARIANCE
from perch_perception.vio import state as at
from perch_perception.vio.msckf import Msckf
from perch_perception.vio.propagation import propagate

_STANDS = float(chi2_quantile(1.0 - 1e-6, 3))
_BIASES = np.r_[9:15]


def can_stand(state: at.State) -> bool:
    """Whether zero lies within what the filter knows of its velocity (chi2): a slow, steady flight is as quiet as the ground."""
    v = state.v_WB
    return bool(v @ np.linalg.solve(state.P[at.VELOCITY, at.VELOCITY], v) < _STANDS)


def stop(filter: Msckf) -> None:
    """The vehicle has come to rest at the state's stamp: what its velocity was wrong by, it was wrong by before."""
    s = filter.state
    s.drop_clones(list(range(len(s.clones))))
    filter.apply(np.r_[at.VELOCITY], np.eye(3), -s.v_WB, REST_VELOCITY**2)


def hold(filter: Msckf, steps: np.ndarray, stamp: int, shaken: float) -> None:
    """The vehicle has rested over IMU steps (m, 9), m > 0, up to their end `stamp` [ns].

    w_mean = b_g + n_w,   f_mean = b_a + R^T g + n_f;  n has `shaken` times the variance of the sensor's noise.
    """
    s, imu = filter.state, filter.config.imu
    T = float(steps[:, DT].sum())
    s.v_WB, s.w_WB_B = np.zeros(3), np.zeros(3)
    s.P[at.VELOCITY, :] = s.P[:, at.VELOCITY] = 0.0
    s.P[at.VELOCITY, at.VELOCITY] = REST_VELOCITY**2 * np.eye(3)
    s.P[_BIASES, _BIASES] += np.repeat([imu.gyro_bias_walk**2 * T, imu.accel_bias_walk**2 * T], 3)
    up_B = s.R_WB.T @ np.array([0.0, 0.0, GRAVITY])
    H = np.zeros((6, at.INERTIAL_SIZE))
    H[:3, at.GYRO_BIAS] = H[3:, at.ACCEL_BIAS] = np.eye(3)
    H[3:, at.THETA] = so3.hat(up_B)
    residual = np.concatenate([steps[:, GYRO].mean(axis=0) - s.gyro_bias, steps[:, ACCEL].mean(axis=0) - s.accel_bias - up_B])
    variance = np.repeat([imu.gyro_noise_density**2, imu.accel_noise_density**2], 3) * shaken / T
    filter.apply(np.arange(at.INERTIAL_SIZE), H, residual, variance)
    s.stamp = stamp


def moved_on(filter: Msckf, steps: np.ndarray, stamp: int, shaken: float) -> at.State:
    """The inertial state at a later stamp [ns], by the IMU steps (m, 9) since the filter's; the filter stays where it is.

    A departure that nobody has noticed yet is in these steps: "at rest" said of now is wrong by 10 cm/s when it is noticed.
    `shaken` as in `hold`.
    """
    n = at.INERTIAL_SIZE
    state = replace(filter.state, stamp=stamp, P=filter.state.P[:n, :n].copy(), clones=[], landmarks={})
    if len(steps):
        rows = steps.copy()
        rows[:, [GYRO_VARIANCE, ACCEL_VARIANCE]] *= shaken
        propagate(state, rows, filter.config.imu)
    return state
