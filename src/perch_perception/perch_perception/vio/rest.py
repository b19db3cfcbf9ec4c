"""Updates of the MSCKF at rest, as in the UKF (`perch_perception.ukf.rest`): constant pose, zero velocity, observed biases.

On the ground, on a wall and on a wire the downward camera sees a few square centimetres from 2-5 cm, or darkness. Nothing can
be triangulated there, but nothing moves either. Rest is detected by `perch_perception.ukf.stillness`.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from perch_core import so3
from perch_core.probability import chi2_quantile
from perch_core.vehicle import GRAVITY

from perch_perception.ukf.imu_buffer import without_gaps
from perch_perception.ukf.stillness import REST_VELOCITY
from perch_perception.ukf.unscented import ACCEL, ACCEL_VARIANCE, DT, GYRO, GYRO_VARIANCE
from perch_perception.vio import state as at
from perch_perception.vio.msckf import Msckf
from perch_perception.vio.propagation import propagate

_VELOCITY_GATE = float(chi2_quantile(1.0 - 1e-6, 3))
_BIASES = np.r_[9:15]


def velocity_may_be_zero(state: at.State) -> bool:
    """Whether the filter's velocity is consistent with zero (chi2): to the IMU, slow, steady flight is as quiet as rest."""
    v = state.v_WB
    return bool(v @ np.linalg.solve(state.P[at.VELOCITY, at.VELOCITY], v) < _VELOCITY_GATE)


def stop(filter: Msckf) -> None:
    """Apply zero velocity at the state's stamp, when the vehicle comes to rest, and drop all clones.

    The velocity's error is older than the stop, so the update corrects all that is correlated with it.
    """
    s = filter.state
    s.drop_clones(list(range(len(s.clones))))
    filter.apply(np.r_[at.VELOCITY], np.eye(3), -s.v_WB, REST_VELOCITY**2)


def hold(filter: Msckf, steps: np.ndarray, stamp: int, noise_factor: float) -> None:
    """Update for a vehicle at rest over IMU steps (m, 9), m > 0, up to their end `stamp` [ns].

    w_mean = b_g + n_w,   f_mean = b_a + R^T g + n_f;  the variance of n is `noise_factor` times that of the sensor's noise.

    Over a gap in the samples the vehicle rests unmeasured: only the biases walk.
    """
    s, imu = filter.state, filter.config.imu
    T, steps = float(steps[:, DT].sum()), without_gaps(steps)
    s.v_WB, s.w_WB_B = np.zeros(3), np.zeros(3)
    s.P[at.VELOCITY, :] = s.P[:, at.VELOCITY] = 0.0
    s.P[at.VELOCITY, at.VELOCITY] = REST_VELOCITY**2 * np.eye(3)
    s.P[_BIASES, _BIASES] += np.repeat([imu.gyro_bias_walk**2 * T, imu.accel_bias_walk**2 * T], 3)
    s.stamp = stamp
    if not len(steps):
        return
    up_B = s.R_WB.T @ np.array([0.0, 0.0, GRAVITY])
    H = np.zeros((6, at.INERTIAL_SIZE))
    H[:3, at.GYRO_BIAS] = H[3:, at.ACCEL_BIAS] = np.eye(3)
    H[3:, at.THETA] = so3.hat(up_B)
    residual = np.concatenate([steps[:, GYRO].mean(axis=0) - s.gyro_bias, steps[:, ACCEL].mean(axis=0) - s.accel_bias - up_B])
    variance = np.repeat([imu.gyro_noise_density**2, imu.accel_noise_density**2], 3) * noise_factor / float(steps[:, DT].sum())
    filter.apply(np.arange(at.INERTIAL_SIZE), H, residual, variance)


def propagated_to(filter: Msckf, steps: np.ndarray, stamp: int, noise_factor: float) -> at.State:
    """Return the inertial state propagated to a later stamp [ns] by IMU steps (m, 9) since the filter's; `filter` is unchanged.

    These steps contain the beginning of a take-off before it is detected: at its detection, a velocity of zero would be wrong by
    10 cm/s. Over a gap in the samples it still rests. `noise_factor` as in `hold`.
    """
    steps = without_gaps(steps)
    n = at.INERTIAL_SIZE
    state = replace(filter.state, stamp=stamp, P=filter.state.P[:n, :n].copy(), clones=[], landmarks={})
    if len(steps):
        rows = steps.copy()
        rows[:, [GYRO_VARIANCE, ACCEL_VARIANCE]] *= noise_factor
        propagate(state, rows, filter.config.imu)
    return state
