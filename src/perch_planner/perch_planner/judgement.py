"""What the plan of one program is worth: every limit proved or in doubt, and cuts against what is found, in one call."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from perch_core.arrays import Array
from perch_core.jit import compiled
from perch_planner.cutting import limit_cuts, thrust_cuts
from perch_planner.linear_bounds import BoundArrays
from perch_planner.plan_checks import check, thrust_extrema

_CUT_REACH = 1.7  # peaks beyond this multiple of the limit are stretched before they are cut


class Question(NamedTuple):
    """What a plan is judged by.

    Attributes:
        p_S, v_S, s3: point of the surface at time 0 [m], its velocity [m/s], outward normal, each shape (3,).
        side: of `cutting.turning_side`, shape (3,).
        low_thrust, high_thrust: limits of the specific thrust [m/s^2].
        speed: limit [m/s].
        low_height, high_height: limits of the height [m].
        extension, clearance: radius of the vehicle's disc, least distance of its rim from the surface [m].
        rate: limit of |omega| [rad/s].
        near: a thrust outside its range by less is cut together with the other limits [m/s^2].
        waypoints: peaks of the thrust in so many segments are stretched rather than cut; those after them only where they
            are high.
    """

    p_S: np.ndarray
    v_S: np.ndarray
    s3: np.ndarray
    side: np.ndarray
    low_thrust: float
    high_thrust: float
    speed: float
    low_height: float
    high_height: float
    extension: float
    clearance: float
    rate: float
    near: float
    waypoints: int


class Judgement(NamedTuple):
    """What was found.

    Attributes:
        coefficients: of the plan, shape (f, 3, 15) [m].
        extrema: of `plan_checks.thrust_extrema`.
        results: of `plan_checks.check`, meaningless unless `checked`.
        least, most: proved extrema of the specific thrust [m/s^2].
        checked: the limits beside the thrust were looked at.
        holds: all limits are proved.
        stretch: a longer time promises more than cuts, and there are none.
        cuts: linear bounds that were found.
    """

    coefficients: np.ndarray
    extrema: np.ndarray
    results: np.ndarray
    least: float
    most: float
    checked: bool
    holds: bool
    stretch: bool
    cuts: int


@compiled
def _better_stretched(extrema: Array, high: float, waypoints: int) -> bool:
    """Whether the thrust's peak lies where a longer time lowers it."""
    segment = extrema[:, 4].argmax()
    peak = extrema[segment, 4]
    return bool(peak > high and (segment < waypoints or peak > _CUT_REACH * high))


@compiled
def judge(coefficients: Array, yaw: Array, durations: Array, question: tuple[Any, ...], patient: bool, later: bool
          ) -> tuple[Array, Array, tuple[float, float, bool, bool, bool], BoundArrays, BoundArrays]:
    """Check a plan, and find cuts against what breaks a limit.

    Args:
        coefficients: of the position, shape (f, 3, 15) [m].
        yaw: of the heading, shape (f, 15) [rad].
        durations: shape (f,) [s].
        question: fields of `Question`.
        patient: give up where longer durations promise more than cuts.
        later: this is not the first program: where the thrust is nearly in its range, the other limits count too.

    Returns:
        (extrema, results, (least, most, checked, holds, stretch), thrust, other): as in `Judgement`; cuts of the thrust and
        of the other limits, fields of `Bounds`.
    """
    p_S, v_S, s3, side, low, high, speed, low_height, high_height, extension, clearance, rate, near, waypoints = question
    extrema, least, most = thrust_extrema(coefficients, durations, low, high)
    broken = most > high or least < low
    stretch = broken and patient and _better_stretched(extrema, high, waypoints)
    checked = not broken or (later and not stretch and min(high - most, least - low) > -near)
    results, where, holds = np.empty((5, 5)), np.full((5, 2), -1.0), False
    if checked:
        results, where, holds = check(coefficients, yaw, durations, extrema, p_S, v_S, s3, low, high, speed, low_height,
                                      high_height, extension, clearance, rate)
    cut = not stretch and not holds
    thrust = thrust_cuts(coefficients, durations, extrema, low if cut else -np.inf, high if cut else np.inf, side)
    if not cut:
        where[:] = -1.0
    other = limit_cuts(where, coefficients, yaw, durations, p_S, v_S, s3, low_height, high_height, speed, rate, extension)
    return extrema, results, (least, most, checked, holds, stretch), thrust, other
