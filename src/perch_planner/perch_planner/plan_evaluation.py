"""Evaluation of the plan of one program in one call: proofs or violations of every limit, and cuts against violations."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from perch_core.arrays import Array
from perch_core.jit import compiled
from perch_planner.cutting import limit_cuts, thrust_cuts
from perch_planner.linear_bounds import BoundArrays
from perch_planner.plan_checks import HOLDS, ROTOR_THRUST, check, thrust_extrema
from perch_planner.rotor_proof import prove_rotors
from perch_planner.rotor_thrusts import Rotors, sample_rotor_thrusts

_CUT_REACH = 1.7          # peaks beyond this multiple of the limit are stretched before they are cut
_ROTOR_CHECK_SHARE = 0.9  # of the least thrust: where the first plan's is greater, its rotors are bounded together with the thrust


class PlanLimits(NamedTuple):
    """Limits and surface against which a plan is checked.

    Attributes:
        p_S, v_S, s3: point of the surface at time 0 [m], its velocity [m/s], outward normal, each shape (3,).
        turn_direction: from `cutting.turn_direction`, shape (3,).
        low_thrust, high_thrust: limits of the specific thrust [m/s^2].
        speed: limit [m/s].
        low_height, high_height: limits of the height [m].
        extension, clearance: radius of the vehicle's disc, least distance of its rim from the surface [m].
        offset: distance of the velcro plate below the centre of mass [m].
        rate: limit of |omega| [rad/s].
        small_violation: violations of the thrust range below this are cut together with the other limits [m/s^2].
        waypoints: their number; thrust peaks in as many first segments are stretched rather than cut, later ones only where
            they are high.
    """

    p_S: np.ndarray
    v_S: np.ndarray
    s3: np.ndarray
    turn_direction: np.ndarray
    low_thrust: float
    high_thrust: float
    speed: float
    low_height: float
    high_height: float
    extension: float
    clearance: float
    offset: float
    rate: float
    small_violation: float
    waypoints: int


@compiled
def _prefer_stretch(extrema: Array, high: float, waypoints: int) -> bool:
    """Whether the thrust peak is to be lowered by longer durations rather than by cuts."""
    segment = extrema[:, 4].argmax()
    peak = extrema[segment, 4]
    return bool(peak > high and (segment < waypoints or peak > _CUT_REACH * high))


@compiled
def check_plan(coefficients: Array, yaw: Array, heading: Array, durations: Array, plan_limits: tuple[Any, ...], rotors: Rotors, allow_stretch: bool,
               after_first: bool) -> tuple[Array, Array, tuple[float, float, bool, bool, bool, bool], BoundArrays, BoundArrays, Array, Array]:
    """Check a plan, and find cuts against violated limits.

    Args:
        coefficients: of the position, shape (f, 3, 15) [m].
        yaw: of the heading, shape (f, 15) [rad].
        heading: from `rotor_thrusts.plan_headings`.
        durations: shape (f,) [s].
        plan_limits: fields of `PlanLimits`.
        rotors: their limits and model.
        allow_stretch: set `stretch` where longer durations promise more than cuts.
        after_first: this is not the first program: the other limits are also checked where the thrust is nearly in its range.

    Returns:
        (extrema, results, (thrust_min, thrust_max, checked, rotors_hold, holds, stretch), thrust, other, motions, thrusts). extrema: from
        `plan_checks.thrust_extrema`; results: rows of `plan_checks.NAMES`, meaningless unless `checked`; thrust_min, thrust_max: proved extrema of
        the specific thrust [m/s^2]; checked: the limits other than the thrust were checked; rotors_hold: no violation of the rotor range was
        found, and its proof did not fail; holds: all limits but the rotor range are proved, and with `rotors_hold` that, too; stretch: longer
        durations promise more than cuts, and none were made; thrust, other: cuts of the thrust and of the other limits, fields of `Bounds`;
        motions, thrusts: from `rotor_thrusts.sample_rotor_thrusts`, empty where the rotors were not checked.
    """
    p_S, v_S, s3, turn_direction, low, high, speed, low_height, high_height, extension, clearance, offset, rate, small_violation, waypoints = plan_limits
    extrema, least, most, forces, squares = thrust_extrema(coefficients, durations, low, high)
    violated = most > high or least < low
    stretch = violated and allow_stretch and _prefer_stretch(extrema, high, waypoints)
    checked = not violated or (after_first and not stretch and min(high - most, least - low) > -small_violation)
    results, where, holds, rotors_hold = np.empty((6, 5)), np.full((5, 2), -1.0), False, True
    if checked:
        results[:5], where, holds = check(coefficients, yaw, durations, extrema, forces, squares, p_S, v_S, s3, low, high, speed,
                                          low_height, high_height, extension, clearance, offset, rate)
    motions, thrusts = np.empty((0, 9, 0)), np.empty((0, 4, 0))
    if checked or not (after_first or stretch or least < _ROTOR_CHECK_SHARE * low):
        low_rotor, high_rotor, mass, J, mixing = rotors
        motions, thrusts, row = sample_rotor_thrusts(coefficients, heading, durations, mass, J, mixing)
        rotors_hold = low_rotor <= row[0] and row[2] <= high_rotor
        if rotors_hold and holds:
            rotors_hold, row[0], row[2] = prove_rotors(coefficients, yaw, durations, row[0], row[2], *rotors)
        results[ROTOR_THRUST, :4], results[ROTOR_THRUST, HOLDS] = row, rotors_hold
    cut = not stretch and not holds
    thrust = thrust_cuts(coefficients, durations, extrema, low if cut else -np.inf, high if cut else np.inf, turn_direction)
    if not cut:
        where[:] = -1.0
    other = limit_cuts(where, coefficients, yaw, durations, p_S, v_S, s3, low_height, high_height, speed, rate, extension, clearance, offset)
    return extrema, results, (least, most, checked, rotors_hold, holds, stretch), thrust, other, motions, thrusts
