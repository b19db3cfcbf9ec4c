"""Standing still: how it is recognised, and what it tells the filter.

On the ground before take-off the downward camera looks at a few square centimetres of floor from 2-5 cm. Nothing can
be triangulated there, but nothing moves either: zero velocity, zero rate and an unchanged pose say more than any track.
"""

from __future__ import annotations

import numpy as np
from perch_core import so3
from perch_core.vehicle import GRAVITY
from scipy.stats import chi2

from perch_perception.ukf.unscented import ACCEL, GYRO
from perch_perception.vio import state as at
from perch_perception.vio.config import StartConfig
from perch_perception.vio.msckf import Msckf

_HOLD = 0.0002  # 1 sigma of "the pose has not changed": [m] and [rad]
_STANDS = float(chi2.ppf(1.0 - 1e-6, 3))


def looks_at_rest(config: StartConfig, steps: np.ndarray, gyro_bias: np.ndarray, accel: np.ndarray | None) -> bool:
    """Whether IMU steps (m, 9) look like standing still.

    Args:
        config: thresholds.
        steps: IMU steps of about 0.1 s or more.
        gyro_bias: what the gyro reads at rest [rad/s], shape (3,).
        accel: what the accelerometer read at rest before [m/s^2], shape (3,); None: only its length is known.
    """
    if len(steps) < 10:
        return False
    w, f = steps[:, GYRO].mean(axis=0) - gyro_bias, steps[:, ACCEL].mean(axis=0)
    change = abs(np.linalg.norm(f) - GRAVITY) if accel is None else np.linalg.norm(f - accel)
    return bool(np.linalg.norm(w) < config.rest_gyro and change < config.rest_accel)


def can_stand(state: at.State) -> bool:
    """Whether zero lies within what the filter knows of its velocity (chi2): a slow, steady flight is as quiet as the ground."""
    v = state.v_WB
    return bool(v @ np.linalg.solve(state.P[at.VELOCITY, at.VELOCITY], v) < _STANDS)


def hold(filter: Msckf, config: StartConfig) -> None:
    """Update with standing still now.

    v = 0, and the pose is that of the window's oldest clone, made when the rest began. The latter is relative: it says
    nothing of where in W that is. It tells the gyro's bias as well, since the filter has just integrated the gyro.
    """
    s = filter.state
    H = np.zeros((9, at.INERTIAL_SIZE + at.CLONE_SIZE))
    H[0:3, at.VELOCITY] = np.eye(3)
    H[3:6, at.THETA], H[3:6, 15:18] = np.eye(3), -np.eye(3)
    H[6:9, at.POSITION], H[6:9, 18:21] = np.eye(3), -np.eye(3)
    anchor = s.clones[0]
    r = np.concatenate([-s.v_WB, so3.log(s.R_WB.T @ anchor.R_WB), anchor.p_WB - s.p_WB])
    variance = np.repeat([config.rest_velocity**2, _HOLD**2, _HOLD**2], 3)
    columns = np.concatenate([np.arange(at.INERTIAL_SIZE), s.clone_at(0) + np.arange(6)])
    filter.apply(columns, H, r, variance)
