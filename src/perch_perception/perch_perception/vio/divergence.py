"""Divergence check of the filter: values that a working filter never produces for a vehicle."""

from __future__ import annotations

import numpy as np
from perch_core import so3
from perch_perception.ukf.stillness import MAX_ACCEL_BIAS, MAX_GYRO_BIAS
from perch_perception.vio import state as at

SPEED_MAX = 25.0  # faster flies no vehicle that this is for [m/s]
_MIN_REFUSED = 20  # observations that may be refused, however few are used
_REFUSED_PER_USED = 4.0  # a filter that is right refuses bad tracks, one that is wrong nearly all: more than this for each that it uses
_MAX_VELOCITY_SIGMA = 1.0  # largest 1 sigma of the velocity [m/s]


def velocity_sigma(state: at.State) -> float:
    """Return 1 sigma of the velocity along its least certain axis of B [m/s].

    Of B, not of W: an unknown heading turns the velocity in W, without harm to the filter. v_B = R^T v, dv_B = R^T dv + [v_B]x theta.
    """
    J = np.hstack([so3.hat(state.R_WB.T @ state.v_WB), state.R_WB.T])
    rows = np.r_[at.THETA, at.VELOCITY]
    return float(np.sqrt(np.diag(J @ state.P[np.ix_(rows, rows)] @ J.T).max()))


def divergence(state: at.State, used: int, refused: int, frames: int) -> str:
    """Return the reason why the filter must restart; empty where it works.

    Args:
        state: of the filter.
        used, refused: numbers of observations used and refused in the latest frames.
        frames: number of these frames.
    """
    speed, gyro, accel = (float(np.linalg.norm(v)) for v in (state.v_WB, state.gyro_bias, state.accel_bias))
    if not np.isfinite(state.P).all() or not np.isfinite(state.p_WB).all():
        return "state is not finite"
    if refused > max(_REFUSED_PER_USED * used, _MIN_REFUSED):
        return f"{refused} observations refused and {used} used in {frames} frames"
    if (sigma := velocity_sigma(state)) > _MAX_VELOCITY_SIGMA:
        return f"velocity known only to {sigma:.1f} m/s"
    if speed > SPEED_MAX:
        return f"a speed of {speed:.1f} m/s"
    if gyro > 2.0 * MAX_GYRO_BIAS or accel > 2.0 * MAX_ACCEL_BIAS:
        return f"biases of {gyro:.2f} rad/s and {accel:.1f} m/s^2: gravity and motion do not fit"
    return ""
