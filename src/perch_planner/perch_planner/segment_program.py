"""One quadratic program for given durations, to which further linear bounds can be added."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from perch_core.jit import compiled
from perch_planner import full_qp, reduced_qp, solvers
from perch_planner.contact_constraints import Contact, conditions_kernel
from perch_planner.cuts_ahead import cuts_ahead
from perch_planner.judgement import NOTHING, Judgement, Question, judge
from perch_planner.linear_bounds import Bounds
from perch_planner.problem import PerchSettings
from perch_planner.reduced_qp import ReducedProgram, assemble_kernel, coefficients_kernel
from perch_planner.reduced_rows import appended, rows_kernel, rows_of
from perch_planner.reference_element import GRAMS
from perch_planner.solvers import Solution

COST_ORDER = {"snap": 4, "jerk": 3}


class SegmentProgram(Protocol):
    """What the search needs of a formulation; made from contact, durations, settings and, for cuts ahead, a question."""

    def add(self, bounds: Bounds) -> None:
        """Add linear bounds to the program."""

    def replace(self, bounds: Bounds) -> None:
        """Set the bounds that hold near the present plan alone, instead of those set before."""

    def solve(self) -> tuple[np.ndarray, Solution]:
        """Bernstein coefficients, shape (f, 3, 15) [m], and the solver's answer; valid where it is `solved`."""

    def judged(self, yaw: np.ndarray, question: Question, patient: bool, later: bool) -> Judgement | None:
        """Solve, judge the plan and add the cuts that were found; None where the program has no solution.

        Args:
            yaw, question, patient, later: as for `judgement.judge`.
        """


@compiled
def _ahead(durations, given, question):
    """`cuts_ahead` for the fields of a `Question`."""
    p_S, v_S, s3, side, low, high, _, _, _, extension, clearance, rate, _, _, _ = question
    return cuts_ahead(durations, given, low, high, side, p_S, v_S, s3, extension, clearance, rate)


@compiled
def _prepare(durations, velocity, problem, everywhere, gram, cost_order, ahead, question):
    """Program and rows of tube, window and cuts ahead in one call: several calls cost more than they compute."""
    given, values, bubbles, bounds = conditions_kernel(durations, everywhere, velocity, problem)
    program = assemble_kernel(durations, given, values, bubbles, gram, cost_order)
    rows, lower, upper = rows_kernel(*program, *bounds)
    if ahead and len(durations) > 1:
        rows, lower, upper = appended(rows, lower, upper, program, _ahead(durations, len(problem[0]) - 1, question))
    return program[1:], rows, lower, upper


@compiled
def _judged(program, rows, lower, upper, w, yaw, question, patient, later):
    """A solution's plan, what it is worth, and the rows with its cuts."""
    coefficients = coefficients_kernel(*program, w)
    extrema, results, found, thrust, other = judge(coefficients, yaw, program[0], question, patient, later)
    cuts = 0
    for bounds in (thrust, other):
        if len(bounds[-1]):
            rows, lower, upper = appended(rows, lower, upper, program, bounds)
            cuts += len(bounds[-1])
    return (coefficients, extrema, results, *found, cuts), rows, lower, upper


class ReducedSegments:
    """The reduced form: see `reduced_qp`."""

    def __init__(self, contact: Contact, durations: np.ndarray, settings: PerchSettings, ahead: Question | None = None) -> None:
        self._solver, cost_order = settings.solver, COST_ORDER[settings.objective]
        everywhere = settings.objective == "jerk" or settings.bubbles == "everywhere"
        program, *self._rows = _prepare(durations, contact.velocity, contact.problem, everywhere, GRAMS[cost_order], cost_order,
                                        ahead is not None, tuple(ahead or NOTHING))
        self._program = ReducedProgram(durations, *program)
        self._local: tuple[np.ndarray, ...] | None = None

    def add(self, bounds: Bounds) -> None:
        """Add linear bounds; only their own rows are computed."""
        self._rows = appended(*self._rows, tuple(self._program), tuple(bounds))

    def replace(self, bounds: Bounds) -> None:
        """Set the bounds near the present plan."""
        self._local = rows_of(self._program, bounds)

    def _least(self) -> Solution:
        rows = self._rows if self._local is None else map(np.concatenate, zip(self._rows, self._local))
        return solvers.least_norm(*rows, self._solver)

    def solve(self) -> tuple[np.ndarray, Solution]:
        """Coefficients and the solver's answer."""
        solution = self._least()
        return reduced_qp.coefficients(self._program, solution.w), solution

    def judged(self, yaw: np.ndarray, question: Question, patient: bool, later: bool) -> Judgement | None:
        """Solve, judge the plan and add the cuts that were found, in one call beside the solver's."""
        solution = self._least()
        if not solution.solved:
            return None
        found, *self._rows = _judged(tuple(self._program), *self._rows, solution.w, yaw, tuple(question), patient, later)
        return Judgement(*found)


class FullSegments:
    """The paper's form: order 14 in every segment, equalities as rows. [M:eq5-8, M:eq17]"""

    def __init__(self, contact: Contact, durations: np.ndarray, settings: PerchSettings, ahead: Question | None = None) -> None:
        self._program = full_qp.FullProgram(durations, *contact.knots(durations), COST_ORDER[settings.objective])
        self._durations, self._solver = durations, settings.solver
        self._program.bound(contact.constraints(durations))
        if ahead is not None and len(durations) > 1:
            self._program.bound(_ahead(durations, len(contact.points) - 1, tuple(ahead)))

    def add(self, bounds: Bounds) -> None:
        """Add linear bounds."""
        self._program.bound(bounds)

    def replace(self, bounds: Bounds) -> None:
        """Set the bounds near the present plan."""
        self._program.replace(bounds)

    def solve(self) -> tuple[np.ndarray, Solution]:
        """Coefficients and the solver's answer."""
        return self._program.solve(self._solver)

    def judged(self, yaw: np.ndarray, question: Question, patient: bool, later: bool) -> Judgement | None:
        """Solve, judge the plan and add the cuts that were found."""
        coefficients, solution = self.solve()
        if not solution.solved:
            return None
        extrema, results, found, *cuts = judge(coefficients, yaw, self._durations, tuple(question), patient, later)
        for bounds in cuts:
            self._program.bound(bounds)
        return Judgement(coefficients, extrema, results, *found, sum(len(bounds[-1]) for bounds in cuts))


FORMULATIONS: dict[str, type[SegmentProgram]] = {"reduced": ReducedSegments, "full": FullSegments}
