"""Evaluation of the plan of one program in one call: proofs or doubts of every limit, and cuts against violations."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from perch_core.arrays import Array
from perch_core.jit import compiled
from perch_planner.cutting import limit_cuts, thrust_cuts
from perch_planner.linear_bounds import BoundArrays
from perch_planner.plan_checks import HOLDS, ROTOR_THRUST, check, thrust_extrema
from perch_planner.rotor_proof import prove_rotors
from perch_planner.rotor_thrusts import Rotors, sampled

_CUT_REACH = 1.7  # peaks beyond this multiple of the limit are stretched before they are cut
_LOOK = 0.9       # of the least thrust: where the first plan's is greater, its rotors are bounded together with the thrust


class Question(NamedTuple):
    """Limits and surface against which a plan is checked.

    Attributes:
        p_S, v_S, s3: point of the surface at time 0 [m], its velocity [m/s], outward normal, each shape (3,).
        side: from `cutting.turning_side`, shape (3,).
        low_thrust, high_thrust: limits of the specific thrust [m/s^2].
        speed: limit [m/s].
        low_height, high_height: limits of the height [m].
        extension, clearance: radius of the vehicle's disc, least distance of its rim from the surface [m].
        rate: limit of |omega| [rad/s].
        near: violations of the thrust range below this are cut together with the other limits [m/s^2].
        waypoints: their number; thrust peaks in as many first segments are stretched rather than cut, later ones only where
            they are high.
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
    """Result of the check of a plan.

    Attributes:
        coefficients: of the plan, shape (f, 3, 15) [m].
        extrema: from `plan_checks.thrust_extrema`.
        results: rows of `plan_checks.NAMES`, meaningless unless `checked`.
        least, most: proved extrema of the specific thrust [m/s^2].
        checked: the limits other than the thrust were checked.
        kept: no violation of the rotor range was found, and its proof did not fail.
        holds: all limits but the rotor range are proved; with `kept`, the rotor range too.
        stretch: longer durations promise more than cuts, and no cuts were made.
        cuts: number of linear bounds found, without those of the rotors.
        near: number of rotor bounds, which are valid near the plan only.
    """

    coefficients: np.ndarray
    extrema: np.ndarray
    results: np.ndarray
    least: float
    most: float
    checked: bool
    kept: bool
    holds: bool
    stretch: bool
    cuts: int
    near: int


@compiled
def _better_stretched(extrema: Array, high: float, waypoints: int) -> bool:
    """Whether the thrust peak is to be lowered by longer durations rather than by cuts."""
    segment = extrema[:, 4].argmax()
    peak = extrema[segment, 4]
    return bool(peak > high and (segment < waypoints or peak > _CUT_REACH * high))


@compiled
def judge(coefficients: Array, yaw: Array, heading: Array, durations: Array, question: tuple[Any, ...], rotors: Rotors, patient: bool,
          later: bool) -> tuple[Array, Array, tuple[float, float, bool, bool, bool, bool], BoundArrays, BoundArrays, Array]:
    """Check a plan, and find cuts against violated limits.

    Args:
        coefficients: of the position, shape (f, 3, 15) [m].
        yaw: of the heading, shape (f, 15) [rad].
        heading: from `rotor_thrusts.plan_headings`.
        durations: shape (f,) [s].
        question: fields of `Question`.
        rotors: their limits and model.
        patient: set `stretch` where longer durations promise more than cuts.
        later: this is not the first program: the other limits are also checked where the thrust is nearly in its range.

    Returns:
        (extrema, results, (least, most, checked, kept, holds, stretch), thrust, other, thrusts): the first three as in
        `Judgement`; thrust, other: cuts of the thrust and of the other limits, fields of `Bounds`; thrusts: from
        `rotor_thrusts.sampled`, empty where the rotors were not checked.
    """
    p_S, v_S, s3, side, low, high, speed, low_height, high_height, extension, clearance, rate, near, waypoints = question
    extrema, least, most = thrust_extrema(coefficients, durations, low, high)
    broken = most > high or least < low
    stretch = broken and patient and _better_stretched(extrema, high, waypoints)
    checked = not broken or (later and not stretch and min(high - most, least - low) > -near)
    results, where, holds, kept = np.empty((6, 5)), np.full((5, 2), -1.0), False, True
    if checked:
        results[:5], where, holds = check(coefficients, yaw, durations, extrema, p_S, v_S, s3, low, high, speed, low_height,
                                          high_height, extension, clearance, rate)
    thrusts = np.empty((0, 4, 0))
    if checked or not (later or stretch or least < _LOOK * low):
        low_rotor, high_rotor, mass, J, mixing = rotors
        thrusts, row = sampled(coefficients, heading, durations, mass, J, mixing)
        kept = low_rotor <= row[0] and row[2] <= high_rotor
        if kept and holds:
            kept, row[0], row[2] = prove_rotors(coefficients, yaw, durations, row[0], row[2], *rotors)
        results[ROTOR_THRUST, :4], results[ROTOR_THRUST, HOLDS] = row, kept
    cut = not stretch and not holds
    thrust = thrust_cuts(coefficients, durations, extrema, low if cut else -np.inf, high if cut else np.inf, side)
    if not cut:
        where[:] = -1.0
    other = limit_cuts(where, coefficients, yaw, durations, p_S + clearance * s3, v_S, s3, low_height, high_height, speed, rate, extension)
    return extrema, results, (least, most, checked, kept, holds, stretch), thrust, other, thrusts
