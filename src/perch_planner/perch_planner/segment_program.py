"""One quadratic program for given durations, to which further linear bounds can be added."""

from __future__ import annotations

from typing import Any

import numpy as np

from perch_core.arrays import Array, Indices
from perch_core.jit import compiled
from perch_planner import solvers
from perch_planner.contact_constraints import Contact, conditions
from perch_planner.plan_checks import ROTOR_THRUST
from perch_planner.plan_evaluation import PlanCheck, PlanLimits, check_plan
from perch_planner.problem import PerchSettings
from perch_planner.reduced_qp import ProgramArrays, assemble, coefficients
from perch_planner.reduced_rows import Rows, rows_of, stacked
from perch_planner.reference_element import GRAMS
from perch_planner.rotor_thrusts import Rotors, plan_headings, rotor_rows

COST_ORDER = {"snap": 4, "jerk": 3}


@compiled
def _prepare(durations: Array, yaw: Array, velocity: Array, problem: tuple[Any, ...], everywhere: bool, gram: Array, cost_order: int
             ) -> tuple[tuple[Indices, float, Array, Array], Rows, Array]:
    """Prepare program, rows of tube and window, and headings in one call, as the overhead of calls exceeds the computation."""
    given, values, bubbles, bounds = conditions(durations, everywhere, velocity, problem)
    program = assemble(durations, given, values, bubbles, gram, cost_order)
    return program[1:], rows_of(program, bounds), plan_headings(yaw, durations)


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
def _next_program(program: ProgramArrays, rows: Rows, keys: Indices, w: Array, dual: Array, yaw: Array, heading: Array,
                  plan_limits: tuple[Any, ...], rotors: Rotors, allow_stretch: bool, after_first: bool, rotor_limits_active: bool
                  ) -> tuple[tuple[Any, ...], Rows, Indices, Array]:
    """Evaluate the plan of a solution, and build the next program.

    Args:
        program: of `reduced_qp.assemble`.
        rows: of the solved program; the last ones, one for each of `keys`, are valid near its plan only.
        w, dual: its solution.
        yaw, heading, plan_limits, rotors, allow_stretch, after_first: as for `plan_evaluation.check_plan`.
        rotor_limits_active: an earlier plan did not keep the rotor range.

    Returns:
        (fields of `PlanCheck`, rows and keys of the next program, multipliers for its warm start).
    """
    plan = coefficients(program, w)
    extrema, results, found, thrust, other, thrusts = check_plan(plan, yaw, heading, program[0], plan_limits, rotors, allow_stretch, after_first)
    fixed, cuts, rotors_hold = len(dual) - len(keys), 0, found[3]
    permanent, local = (rows[0][:fixed], rows[1][:fixed], rows[2][:fixed]), (rows[0][fixed:], rows[1][fixed:], rows[2][fixed:])
    for bounds in (thrust, other):
        if len(bounds[-1]):
            permanent = stacked(permanent, rows_of(program, bounds))
            cuts += len(bounds[-1])
    new_keys, count = keys, 0
    if len(thrusts) and (rotor_limits_active or not rotors_hold) and not (rotors_hold and found[4]):
        new_keys, local = rotor_rows(program, thrusts, results[ROTOR_THRUST], plan, heading, *rotors)
        count = len(new_keys)
    start = np.concatenate((dual[:fixed], np.zeros(cuts), _transfer_multipliers(keys, dual[fixed:], new_keys)))
    return (plan, extrema, results, *found, cuts, count), stacked(permanent, local), new_keys, start


class SegmentProgram:
    """The reduced program (`reduced_qp`) of a perch with the durations of its segments [s], shape (f,), and its rows.

    Args:
        contact, durations, settings: of the program.
        yaw, plan_limits, rotors: as for `plan_evaluation.check_plan`.
    """

    def __init__(self, contact: Contact, durations: Array, settings: PerchSettings, yaw: Array, plan_limits: PlanLimits, rotors: Rotors) -> None:
        self._solver, self._plan_limits, self._rotors, cost_order = settings.solver, tuple(plan_limits), rotors, COST_ORDER[settings.objective]
        program, self._rows, heading = _prepare(durations, yaw, contact.velocity, contact.problem, settings.objective == "jerk",
                                                GRAMS[cost_order], cost_order)
        self._program: ProgramArrays = (durations, *program)
        self._yaw, self._heading = yaw, heading
        self._keys: Indices = np.empty(0, np.int64)  # of rows that hold near the present plan only
        self._dual: Array | None = None
        self.rotor_limits_active = False
        """Whether a plan of this program did not keep the rotor range."""

    def solve_and_check(self, allow_stretch: bool, after_first: bool) -> PlanCheck | None:
        """Solve, check the plan and add the bounds that were found; None where the program has no solution.

        Args:
            allow_stretch, after_first: as for `plan_evaluation.check_plan`.
        """
        solution = solvers.least_norm(*self._rows, self._solver, self._dual)
        if not solution.solved:
            return None
        dual = np.zeros(len(self._rows[1])) if solution.dual is None else solution.dual
        fields, self._rows, self._keys, self._dual = _next_program(
            self._program, self._rows, self._keys, solution.w, dual, self._yaw, self._heading, self._plan_limits, self._rotors, allow_stretch,
            after_first, self.rotor_limits_active)
        check = PlanCheck(*fields)
        self.rotor_limits_active = self.rotor_limits_active or not check.rotors_hold
        return check
