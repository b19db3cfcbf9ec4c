"""One quadratic program for given durations, to which further linear bounds can be added."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

from perch_planner import full_qp, reduced_qp, solvers
from perch_planner.contact_constraints import Contact
from perch_planner.problem import PerchSettings
from perch_planner.solvers import Solution

COST_ORDER = {"snap": 4, "jerk": 3}


class Cut(NamedTuple):
    """A linear bound at one place of the plan: lower <= sum of direction . (order-th derivative) <= upper.

    Attributes:
        segment, place: where, place in [0, 1] of the segment.
        terms: pairs (order, direction): time derivative, 0 position to 3 jerk, and a vector in W, shape (3,).
        lower, upper: bounds of the sum.
    """

    segment: int
    place: float
    terms: tuple[tuple[int, np.ndarray], ...]
    lower: float
    upper: float


class SegmentProgram(Protocol):
    """What the search needs of a formulation."""

    def add(self, cuts: list[Cut]) -> None:
        """Add linear bounds to the program."""

    def replace(self, bounds: list[Cut]) -> None:
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

    def add(self, cuts: list[Cut]) -> None:
        """Add linear bounds; only their own rows are computed."""
        self._rows = tuple(np.concatenate(pair) for pair in zip(self._rows, self._further(cuts)))

    def replace(self, bounds: list[Cut]) -> None:
        """Set the bounds near the present plan."""
        self._local = self._further(bounds) if bounds else None

    def _further(self, cuts: list[Cut]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        terms = [(k, cut, *term) for k, cut in enumerate(cuts) for term in cut.terms]
        return reduced_qp.further_rows(
            self._program, self._durations, self._bubbles, np.array([k for k, *_ in terms]),
            np.array([cut.segment for _, cut, *_ in terms]), np.array([cut.place for _, cut, *_ in terms]),
            np.array([order for *_, order, _ in terms]), np.array([direction for *_, direction in terms]),
            np.array([cut.lower for cut in cuts]), np.array([cut.upper for cut in cuts]))

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
        for q, direction, lower, upper in zip(linear.functional, linear.direction, linear.lower, linear.upper):
            self._program.bound(linear.segments[q], linear.places[q], ((linear.orders[q], direction),), lower, upper)

    def add(self, cuts: list[Cut]) -> None:
        """Add linear bounds."""
        for cut in cuts:
            self._program.bound(*cut)

    def replace(self, bounds: list[Cut]) -> None:
        """Set the bounds near the present plan."""
        self._program.replace(bounds)

    def solve(self) -> tuple[np.ndarray, Solution]:
        """Coefficients and the solver's answer."""
        return self._program.solve(self._solver)


FORMULATIONS = {"reduced": ReducedSegments, "full": FullSegments}
