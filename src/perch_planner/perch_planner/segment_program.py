"""One quadratic program for given durations, to which further linear bounds can be added."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

from perch_planner import full_qp, reduced_qp, solvers
from perch_planner.contact_constraints import Contact
from perch_planner.problem import PerchSettings
from perch_planner.solvers import Solution

COST_ORDER = {"snap": 4, "jerk": 3}


class Bounds(NamedTuple):
    """Linear bounds at single places of the plan: lower <= sum of direction . (order-th derivative) <= upper.

    Attributes:
        owner: bound to which each term adds, shape (t,).
        segments, places, orders: where a term is taken, place in [0, 1] of the segment, and its time derivative, 0
            position to 4 snap; each shape (t,).
        direction: vector in W of each term, shape (t, 3).
        lower, upper: bounds of the sums, shape (r,).
    """

    owner: np.ndarray
    segments: np.ndarray
    places: np.ndarray
    orders: np.ndarray
    direction: np.ndarray
    lower: np.ndarray
    upper: np.ndarray


class SegmentProgram(Protocol):
    """What the search needs of a formulation."""

    def add(self, bounds: Bounds) -> None:
        """Add linear bounds to the program."""

    def replace(self, bounds: Bounds) -> None:
        """Set the bounds that hold near the present plan alone, instead of those set before."""

    def solve(self) -> tuple[np.ndarray, Solution]:
        """Bernstein coefficients, shape (f, 3, 15) [m], and the solver's answer; valid where it is `solved`."""


class ReducedSegments:
    """The reduced form: see `reduced_qp`."""

    def __init__(self, contact: Contact, durations: np.ndarray, settings: PerchSettings) -> None:
        linear = contact.constraints(durations)
        self._durations, self._solver = durations, settings.solver
        self._bubbles = contact.bubbles(
            durations, linear, settings.objective == "jerk" or settings.bubbles == "everywhere")
        self._program = reduced_qp.assemble(durations, *contact.knots(durations), self._bubbles, linear.segments,
                                            linear.places, linear.orders, COST_ORDER[settings.objective])
        self._local: tuple[np.ndarray, ...] | None = None
        self._rows = reduced_qp.constraint_rows(self._program, linear.functional, linear.direction, linear.lower, linear.upper)

    def add(self, bounds: Bounds) -> None:
        """Add linear bounds; only their own rows are computed."""
        self._rows = tuple(map(np.concatenate, zip(self._rows, self._further(bounds))))

    def replace(self, bounds: Bounds) -> None:
        """Set the bounds near the present plan."""
        self._local = self._further(bounds)

    def _further(self, bounds: Bounds) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return reduced_qp.further_rows(self._program, self._durations, self._bubbles, *bounds)

    def solve(self) -> tuple[np.ndarray, Solution]:
        """Coefficients and the solver's answer."""
        rows = self._rows if self._local is None else map(np.concatenate, zip(self._rows, self._local))
        solution = solvers.least_norm(*rows, self._solver)
        return reduced_qp.coefficients(self._program, self._durations, self._bubbles, solution.w), solution


class FullSegments:
    """The paper's form: order 14 in every segment, equalities as rows. [M:eq5-8, M:eq17]"""

    def __init__(self, contact: Contact, durations: np.ndarray, settings: PerchSettings) -> None:
        self._program = full_qp.FullProgram(durations, *contact.knots(durations), COST_ORDER[settings.objective])
        self._solver = settings.solver
        linear = contact.constraints(durations)
        at = linear.functional
        self._program.bound(Bounds(np.arange(len(at)), linear.segments[at], linear.places[at], linear.orders[at],
                                   linear.direction, linear.lower, linear.upper))

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
