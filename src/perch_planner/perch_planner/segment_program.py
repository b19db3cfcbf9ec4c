"""One quadratic program for given durations, to which further linear bounds can be added."""

from __future__ import annotations

from typing import Any

import numpy as np

from perch_core.arrays import Array, Indices
from perch_core.jit import compiled
from perch_planner import solvers
from perch_planner.contact_constraints import Contact, conditions
from perch_planner.judgement import Judgement, Question, judge
from perch_planner.linear_bounds import BoundArrays
from perch_planner.problem import PerchSettings
from perch_planner.reduced_qp import ProgramArrays, assemble, coefficients
from perch_planner.reduced_rows import Rows, rows_of, stacked
from perch_planner.reference_element import GRAMS

COST_ORDER = {"snap": 4, "jerk": 3}


@compiled
def _prepare(durations: Array, velocity: Array, problem: tuple[Any, ...], everywhere: bool, gram: Array, cost_order: int
             ) -> tuple[tuple[Indices, float, Array, Array], Rows]:
    """Program and rows of tube and window in one call: several calls cost more than they compute."""
    given, values, bubbles, bounds = conditions(durations, everywhere, velocity, problem)
    program = assemble(durations, given, values, bubbles, gram, cost_order)
    return program[1:], rows_of(program, bounds)


@compiled
def _judged(program: ProgramArrays, rows: Rows, w: Array, yaw: Array, question: tuple[Any, ...], patient: bool, later: bool
            ) -> tuple[tuple[Any, ...], Rows]:
    """A solution's plan, what it is worth, and the rows with its cuts."""
    plan = coefficients(program, w)
    extrema, results, found, thrust, other = judge(plan, yaw, program[0], question, patient, later)
    cuts = 0
    for bounds in (thrust, other):
        if len(bounds[-1]):
            rows = stacked(rows, rows_of(program, bounds))
            cuts += len(bounds[-1])
    return (plan, extrema, results, *found, cuts), rows


@compiled
def _carried(keys: Indices, dual: Array, to: Indices) -> Array:
    """Multipliers of rows with ascending keys, for rows with other ascending keys; zero where there was none."""
    out, i = np.zeros(len(to)), 0
    for k in range(len(to)):
        while i < len(keys) and keys[i] < to[k]:
            i += 1
        if i < len(keys) and keys[i] == to[k]:
            out[k] = dual[i]
    return out


class SegmentProgram:
    """The reduced program (`reduced_qp`) of a perch with the durations of its segments [s], shape (f,), and its rows."""

    def __init__(self, contact: Contact, durations: Array, settings: PerchSettings, question: Question) -> None:
        self._solver, self._question, cost_order = settings.solver, tuple(question), COST_ORDER[settings.objective]
        program, self._rows = _prepare(durations, contact.velocity, contact.problem, settings.objective == "jerk", GRAMS[cost_order],
                                       cost_order)
        self._program: ProgramArrays = (durations, *program)
        self._local: Rows | None = None
        self._keys: Indices = np.empty(0, np.int64)
        self._dual: tuple[Array, Array] | None = None  # of the present rows, and of those that hold near the present plan

    def replace(self, keys: Indices, bounds: BoundArrays) -> None:
        """Set the bounds that hold near the present plan alone, instead of those set before; bounds of one key replace each other.

        Args:
            keys: ascending.
            bounds: one for each key.
        """
        if self._dual is not None:
            self._dual = self._dual[0], _carried(self._keys, self._dual[1], keys)
        self._local, self._keys = rows_of(self._program, bounds), keys

    def judged(self, yaw: Array, patient: bool, later: bool) -> Judgement | None:
        """Solve, judge the plan and add the cuts that were found; None where the program has no solution.

        Args:
            yaw, patient, later: as for `judgement.judge`.
        """
        rows = self._rows if self._local is None else stacked(self._rows, self._local)
        fixed = len(self._rows[1])
        start = None if self._dual is None else np.concatenate((self._dual[0], np.zeros(fixed - len(self._dual[0])), self._dual[1]))
        solution = solvers.least_norm(*rows, self._solver, start)
        if not solution.solved:
            return None
        self._dual = None if solution.dual is None else (solution.dual[:fixed], solution.dual[fixed:])
        found, self._rows = _judged(self._program, self._rows, solution.w, yaw, self._question, patient, later)
        return Judgement(*found)
