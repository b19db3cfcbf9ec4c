"""One quadratic program for given durations, to which further linear bounds can be added."""

from __future__ import annotations

from typing import Any

import numpy as np

from perch_core.arrays import Array, Indices
from perch_core.jit import compiled
from perch_planner import solvers
from perch_planner.contact_constraints import Contact, conditions
from perch_planner.judgement import Judgement, Question, judge
from perch_planner.plan_checks import ROTOR_THRUST
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
def _carried(keys: Indices, dual: Array, to: Indices) -> Array:
    """Transfer multipliers of rows with ascending keys to rows with other ascending keys; zero for new keys."""
    out, i = np.zeros(len(to)), 0
    for k in range(len(to)):
        while i < len(keys) and keys[i] < to[k]:
            i += 1
        if i < len(keys) and keys[i] == to[k]:
            out[k] = dual[i]
    return out


@compiled
def _judged(program: ProgramArrays, rows: Rows, keys: Indices, w: Array, dual: Array, yaw: Array, heading: Array,
            question: tuple[Any, ...], rotors: Rotors, patient: bool, later: bool, turning: bool) -> tuple[tuple[Any, ...], Rows, Indices, Array]:
    """Evaluate the plan of a solution, and build the next program.

    Args:
        program: of `reduced_qp.assemble`.
        rows: of the solved program; the last ones, one for each of `keys`, are valid near its plan only.
        w, dual: its solution.
        yaw, heading, question, rotors, patient, later: as for `judgement.judge`.
        turning: an earlier plan did not keep the rotor range.

    Returns:
        (fields of `Judgement`, rows and keys of the next program, multipliers for its warm start).
    """
    plan = coefficients(program, w)
    extrema, results, found, thrust, other, thrusts = judge(plan, yaw, heading, program[0], question, rotors, patient, later)
    fixed, cuts, kept = len(dual) - len(keys), 0, found[3]
    always, near = (rows[0][:fixed], rows[1][:fixed], rows[2][:fixed]), (rows[0][fixed:], rows[1][fixed:], rows[2][fixed:])
    for bounds in (thrust, other):
        if len(bounds[-1]):
            always = stacked(always, rows_of(program, bounds))
            cuts += len(bounds[-1])
    to, count = keys, 0
    if len(thrusts) and (turning or not kept) and not (kept and found[4]):
        to, near = rotor_rows(program, thrusts, results[ROTOR_THRUST], plan, heading, *rotors)
        count = len(to)
    start = np.concatenate((dual[:fixed], np.zeros(cuts), _carried(keys, dual[fixed:], to)))
    return (plan, extrema, results, *found, cuts, count), stacked(always, near), to, start


class SegmentProgram:
    """The reduced program (`reduced_qp`) of a perch with the durations of its segments [s], shape (f,), and its rows.

    Args:
        contact, durations, settings: of the program.
        yaw, question, rotors: as for `judgement.judge`.
    """

    def __init__(self, contact: Contact, durations: Array, settings: PerchSettings, yaw: Array, question: Question, rotors: Rotors) -> None:
        self._solver, self._question, self._rotors, cost_order = settings.solver, tuple(question), rotors, COST_ORDER[settings.objective]
        program, self._rows, heading = _prepare(durations, yaw, contact.velocity, contact.problem, settings.objective == "jerk",
                                                GRAMS[cost_order], cost_order)
        self._program: ProgramArrays = (durations, *program)
        self._yaw, self._heading = yaw, heading
        self._keys: Indices = np.empty(0, np.int64)  # of rows that hold near the present plan alone
        self._dual: Array | None = None
        self.turning = False
        """Whether a plan of this program did not keep the rotor range."""

    def judged(self, patient: bool, later: bool) -> Judgement | None:
        """Solve, check the plan and add the bounds that were found; None where the program has no solution.

        Args:
            patient, later: as for `judgement.judge`.
        """
        solution = solvers.least_norm(*self._rows, self._solver, self._dual)
        if not solution.solved:
            return None
        dual = np.zeros(len(self._rows[1])) if solution.dual is None else solution.dual
        fields, self._rows, self._keys, self._dual = _judged(
            self._program, self._rows, self._keys, solution.w, dual, self._yaw, self._heading, self._question, self._rotors, patient, later,
            self.turning)
        found = Judgement(*fields)
        self.turning = self.turning or not found.kept
        return found
