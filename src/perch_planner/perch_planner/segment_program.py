"""One quadratic program for given durations, to which further linear bounds can be added."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from perch_core.jit import compiled
from perch_planner import full_qp, reduced_qp, solvers
from perch_planner.contact_constraints import Contact, bounds_kernel, bubbles_kernel, knots_kernel
from perch_planner.linear_bounds import NONE, Bounds
from perch_planner.problem import PerchSettings
from perch_planner.reduced_qp import ReducedProgram, assemble_kernel
from perch_planner.reduced_rows import appended, rows_kernel, rows_of
from perch_planner.reference_element import GRAMS
from perch_planner.solvers import Solution

COST_ORDER = {"snap": 4, "jerk": 3}


class SegmentProgram(Protocol):
    """What the search needs of a formulation; made from contact, durations, settings and bounds that are known ahead."""

    def add(self, bounds: Bounds) -> None:
        """Add linear bounds to the program."""

    def replace(self, bounds: Bounds) -> None:
        """Set the bounds that hold near the present plan alone, instead of those set before."""

    def solve(self) -> tuple[np.ndarray, Solution]:
        """Bernstein coefficients, shape (f, 3, 15) [m], and the solver's answer; valid where it is `solved`."""


@compiled
def _prepare(durations, knots, tube_and_window, complete, ahead, everywhere, gram, cost_order):
    """Program and rows of tube, window and further bounds in one call: several calls cost more than they compute."""
    given, values = knots_kernel(durations, *knots)
    bounds = bounds_kernel(durations, *tube_and_window)
    bubbles = bubbles_kernel(len(durations), bounds[1][0], complete, everywhere)
    program = assemble_kernel(durations, given, values, bubbles, gram, cost_order)
    rows, lower, upper = rows_kernel(*program, *bounds)
    return program, appended(rows, lower, upper, program, ahead)


class ReducedSegments:
    """The reduced form: see `reduced_qp`."""

    def __init__(self, contact: Contact, durations: np.ndarray, settings: PerchSettings, ahead: Bounds = NONE) -> None:
        self._solver, cost_order = settings.solver, COST_ORDER[settings.objective]
        everywhere = settings.objective == "jerk" or settings.bubbles == "everywhere"
        program, self._rows = _prepare(durations, contact.at_knots, contact.before_contact, contact.complete, tuple(ahead),
                                       everywhere, GRAMS[cost_order], cost_order)
        self._program = ReducedProgram(*program)
        self._local: tuple[np.ndarray, ...] | None = None

    def add(self, bounds: Bounds) -> None:
        """Add linear bounds; only their own rows are computed."""
        self._rows = appended(*self._rows, tuple(self._program), tuple(bounds))

    def replace(self, bounds: Bounds) -> None:
        """Set the bounds near the present plan."""
        self._local = rows_of(self._program, bounds)

    def solve(self) -> tuple[np.ndarray, Solution]:
        """Coefficients and the solver's answer."""
        rows = self._rows if self._local is None else map(np.concatenate, zip(self._rows, self._local))
        solution = solvers.least_norm(*rows, self._solver)
        return reduced_qp.coefficients(self._program, solution.w), solution


class FullSegments:
    """The paper's form: order 14 in every segment, equalities as rows. [M:eq5-8, M:eq17]"""

    def __init__(self, contact: Contact, durations: np.ndarray, settings: PerchSettings, ahead: Bounds = NONE) -> None:
        self._program = full_qp.FullProgram(durations, *contact.knots(durations), COST_ORDER[settings.objective])
        self._solver = settings.solver
        self._program.bound(contact.constraints(durations))
        self._program.bound(ahead)

    def add(self, bounds: Bounds) -> None:
        """Add linear bounds."""
        self._program.bound(bounds)

    def replace(self, bounds: Bounds) -> None:
        """Set the bounds near the present plan."""
        self._program.replace(bounds)

    def solve(self) -> tuple[np.ndarray, Solution]:
        """Coefficients and the solver's answer."""
        return self._program.solve(self._solver)


FORMULATIONS = {"reduced": ReducedSegments, "full": FullSegments}
