"""Quadratic programs for given durations, with linear bounds against what their plans violate, in one compiled kernel."""

from __future__ import annotations

from typing import Any

import numpy as np

from perch_core.arrays import Array, Flags, Indices
from perch_core.jit import compiled
from perch_planner.active_set import shortest
from perch_planner.contact_constraints import conditions
from perch_planner.plan_checks import BODY_RATE, HEIGHT, HOLDS, MAXIMUM, MINIMUM, ROTOR_THRUST, SPEED
from perch_planner.plan_evaluation import check_plan
from perch_planner.reduced_qp import assemble, coefficients
from perch_planner.reduced_rows import put, rows_of
from perch_planner.rotor_thrusts import Rotors, plan_headings, rotor_rows

COST_ORDER = {"snap": 4, "jerk": 3}
VIOLATED = ("thrust_min", "thrust_max", "rotor_margin", "speed_max", "body_rate_max", "height_min", "height_max")
"""Names of the settings of the limits that plans may violate."""
_REPEATED = 1e-3  # of the largest entry of a solution: smaller differences repeat it


@compiled
def _transfer_multipliers(keys: Indices, dual: Array, new_keys: Indices) -> Array:
    """Transfer multipliers of rows with ascending keys to rows with other ascending keys; zero for new keys."""
    out, i = np.zeros(len(new_keys)), 0
    for k in range(len(new_keys)):
        while i < len(keys) and keys[i] < new_keys[k]:
            i += 1
        if i < len(keys) and keys[i] == new_keys[k]:
            out[k] = dual[i]
    return out


@compiled
def _record_violations(violated: Flags, results: Array, low: bool, high: bool, rotors_hold: bool, checked: bool, low_height: float, high_height: float) -> None:
    """Set the flags, by `VIOLATED`, of the limits that a plan does not keep."""
    violated[0], violated[1], violated[2] = violated[0] or low, violated[1] or high, violated[2] or not rotors_hold
    if checked:
        violated[3], violated[4] = violated[3] or results[SPEED, HOLDS] == 0.0, violated[4] or results[BODY_RATE, HOLDS] == 0.0
        violated[5], violated[6] = violated[5] or results[HEIGHT, MINIMUM] < low_height, violated[6] or results[HEIGHT, MAXIMUM] > high_height


@compiled
def _repeats(earlier: Array, w: Array) -> bool:
    """Whether a solution is one of the earlier ones, shape (k, n): the linearised bounds then recur, too."""
    for k in range(len(earlier)):
        if np.abs(w - earlier[k]).max() <= _REPEATED * np.abs(w).max():
            return True
    return False


@compiled
def solve(durations: Array, yaw: Array, velocity: Array, problem: tuple[Any, ...], everywhere: bool, gram: Array, cost_order: int,
          plan_limits: tuple[Any, ...], rotors: Rotors, allow_stretch: bool, programs_max: int
          ) -> tuple[Array, Flags, Array, Array, Array, tuple[float, float, bool, bool, int]]:
    """Solve and check quadratic programs, each with bounds against what the plan before it violates, until a plan keeps all limits.

    Also ended by a program without solution, by a plan against which no bound is known, by one that repeats an earlier plan, as the programs
    after it would, and after `programs_max` programs.

    Args:
        durations: of the segments [s], shape (f,).
        velocity, problem: attributes of `Contact`.
        everywhere: all segments have bubbles.
        gram, cost_order: as for `reduced_qp.assemble`.
        yaw, plan_limits, rotors, allow_stretch: as for `plan_evaluation.check_plan`.
        programs_max: at least 1.

    Returns:
        (programs, violated, plan, extrema, results, (least, most, proved, stretch, cuts)): programs: least and greatest specific thrust
        of each plan [m/s^2], nan where there is none, and bounds so far, shape (k, 3); violated: limits that a plan violated, by `VIOLATED`;
        the rest is that of the last plan: coefficients [m], shape (f, 3, 15), empty where there is none, and results of `check_plan`;
        cuts: number of bounds that were found.
    """
    given, values, bubbles, bounds = conditions(durations, everywhere, velocity, problem)
    program = assemble(durations, given, values, bubbles, gram, cost_order)
    rows, heading = rows_of(program, bounds), plan_headings(yaw, durations)
    fixed, keys = len(rows[1]), np.empty(0, np.int64)  # number of lasting rows, and keys of those that hold near the present plan only
    local, start = (rows[0][:0], rows[1][:0], rows[2][:0]), np.zeros(fixed)
    solutions = np.empty((programs_max, rows[0].shape[1]))
    programs, violated, count = np.empty((programs_max, 3)), np.zeros(len(VIOLATED), np.bool_), 0
    plan, extrema, results = np.empty((0, 3, 15)), np.empty((0, 6)), np.empty((0, 5))
    low, high, low_height, high_height = plan_limits[4], plan_limits[5], plan_limits[7], plan_limits[8]
    proved = stretch = False
    least, most, done = np.inf, -np.inf, 0
    for k in range(programs_max):
        size = len(start)
        w, dual, found = shortest(rows[0][:size], rows[1][:size], rows[2][:size], start)
        done = k + 1
        programs[k, 0], programs[k, 1], programs[k, 2] = np.nan, np.nan, count
        if not found:
            break
        plan = coefficients(program, w)
        extrema, results, state, thrust, other, motions, thrusts = check_plan(plan, yaw, heading, durations, plan_limits, rotors, allow_stretch,
                                                                              k > 0)
        least, most, checked, rotors_hold, holds, stretch = state
        programs[k, 0], programs[k, 1] = least, most
        if holds and rotors_hold:
            proved = True
            break
        _record_violations(violated, results, least < low, most > high, rotors_hold, checked, low_height, high_height)
        if stretch:
            break
        known, cuts = fixed, 0
        for found_bounds in (thrust, other):
            if len(found_bounds[6]) > 0:
                rows = put(rows, known + cuts, rows_of(program, found_bounds))
                cuts += len(found_bounds[6])
        if cuts == 0 and (not violated[2] or _repeats(solutions[:k], w)):
            break
        solutions[k] = w
        old_keys = keys
        if len(thrusts) > 0 and violated[2]:
            keys, local = rotor_rows(program, motions, thrusts, results[ROTOR_THRUST], heading, *rotors)
            count += len(keys)
        fixed, count = known + cuts, count + cuts
        rows = put(rows, fixed, local)
        start = np.concatenate((dual[:known], np.zeros(cuts), _transfer_multipliers(old_keys, dual[known:], keys)))
    return programs[:done], violated, plan, extrema, results, (least, most, proved, stretch, count)
