"""Profile of the fourth flat output, yaw, from the heading at the start to that of the surface. [M:eq4, M:eq12]

No constraint couples yaw to the position, and waypoints leave it free: its own QP [M:eq8] has the end conditions
alone, and its optimum is one polynomial over the whole plan (degree 7 for snap, 5 for jerk), known in closed form.
"""

from __future__ import annotations

import numpy as np

from perch_core.arrays import Array
from perch_core.jit import compiled
from perch_planner.bounds import elevated
from perch_planner.reference_element import DEGREE


@compiled
def _restrict(coefficients: Array, a: float, b: float) -> Array:
    """The polynomial on [a, b], mapped to [0, 1]."""
    n = len(coefficients) - 1
    out = coefficients.copy()
    # De Casteljau twice: keep [a, 1], then of that the part up to b.
    for k in range(n):
        for i in range(n - k):
            out[i] = (1.0 - a) * out[i] + a * out[i + 1]
    u = (b - a) / (1.0 - a) if a < 1.0 else 1.0
    for k in range(n):
        for i in range(n, k, -1):
            out[i] = (1.0 - u) * out[i - 1] + u * out[i]
    return out


@compiled
def _yaw(yaw: float, rate: float, acceleration: float, end: float, durations: Array, degree: int) -> Array:
    duration = durations.sum()
    whole = np.full(degree + 1, end)
    whole[0] = yaw
    whole[1] = yaw + rate * duration / degree
    whole[2] = 2.0 * whole[1] - whole[0] + acceleration * duration**2 / (degree * (degree - 1))
    if degree == 7:
        whole[3] = 3.0 * whole[2] - 3.0 * whole[1] + whole[0]
    whole = elevated(whole, DEGREE + 1)
    out = np.empty((len(durations), DEGREE + 1))
    begin = 0.0
    for i in range(len(durations)):
        part = _restrict(whole, begin / duration, min((begin + durations[i]) / duration, 1.0))
        begin += durations[i]
        for k in range(DEGREE + 1):
            out[i, k] = part[k]
    return out


def nearest_turn(yaw: float, end: float) -> float:
    """The angle equal to `end` modulo a full turn that is nearest to `yaw` [rad]."""
    return yaw + (end - yaw + np.pi) % (2.0 * np.pi) - np.pi


def yaw_coefficients(yaw: float, rate: float, acceleration: float, end: float, durations: np.ndarray,
                     cost_order: int) -> np.ndarray:
    """Bernstein coefficients of the heading, at rest at the end. [M:eq8 for d = 4]

    Args:
        yaw, rate, acceleration: at the start [rad, rad/s, rad/s^2].
        end: heading at contact [rad]; the shorter turn is taken.
        durations: segment durations [s], shape (f,).
        cost_order: 4 minimises snap (jerk vanishes at both ends), 3 jerk.

    Returns:
        Shape (f, 15) [rad].
    """
    return _yaw(yaw, rate, acceleration, nearest_turn(yaw, end), durations, 7 if cost_order == 4 else 5)
