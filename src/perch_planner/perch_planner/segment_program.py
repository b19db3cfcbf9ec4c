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
    """A linear bound at one place of the plan: lower <= direction . (order-th derivative) <= upper.

    Attributes:
        segment, place: where, place in [0, 1] of the segment.
        order: time derivative, 0 position to 3 jerk.
        direction: unit vector in W, shape (3,).
        lower, upper: bounds in the derivative's SI unit.
    """

    segment: int
    place: float
    order: int
    direction: np.ndarray
    lower: float
    upper: float


class SegmentProgram(Protocol):
    """What the search needs of a formulation."""

    def add(self, cuts: list[Cut]) -> None:
        """Add linear bounds to the program."""

    def solve(self) -> tuple[np.ndarray, Solution]:
        """Bernstein coefficients, shape (f, 3, 15) [m], and the solver's answer; valid where it is `solved`."""


def _arrays(cuts: list[Cut]):
    return (np.array([c.segment for c in cuts], np.int64), np.array([c.place for c in cuts]),
            np.array([c.order for c in cuts], np.int64), np.array([c.direction for c in cuts]),
            np.array([c.lower for c in cuts]), np.array([c.upper for c in cuts]))


class ReducedSegments:
    """The reduced form: see `reduced_qp`."""

    def __init__(self, contact: Contact, durations: np.ndarray, settings: PerchSettings) -> None:
        linear = contact.constraints(durations)
        self._durations, self._solver = durations, settings.solver
        self._bubbles = contact.bubbles(durations, linear, settings.objective == "jerk")
        self._program = reduced_qp.assemble(durations, *contact.knots(durations), self._bubbles, linear.segments,
                                            linear.places, linear.orders, COST_ORDER[settings.objective])
        self._rows = reduced_qp.constraint_rows(self._program, linear.functional, linear.direction, linear.lower, linear.upper)

    def add(self, cuts: list[Cut]) -> None:
        """Add linear bounds; only their own rows are computed."""
        segments, places, orders, direction, lower, upper = _arrays(cuts)
        more = reduced_qp.extend(self._program, self._durations, self._bubbles, segments, places, orders)
        rows = reduced_qp.constraint_rows(more, np.arange(len(cuts)), direction, lower, upper)
        self._rows = tuple(np.concatenate(pair) for pair in zip(self._rows, rows))

    def solve(self) -> tuple[np.ndarray, Solution]:
        """Coefficients and the solver's answer."""
        solution = solvers.least_norm(*self._rows, self._solver)
        return reduced_qp.coefficients(self._program, self._durations, self._bubbles, solution.w), solution


class FullSegments:
    """The paper's form: order 14 in every segment, equalities as rows. [M:eq5-8, M:eq17]"""

    def __init__(self, contact: Contact, durations: np.ndarray, settings: PerchSettings) -> None:
        self._program = full_qp.FullProgram(durations, *contact.knots(durations), COST_ORDER[settings.objective])
        self._solver = settings.solver
        linear = contact.constraints(durations)
        pick = linear.functional
        self._program.bound(linear.segments[pick], linear.places[pick], linear.orders[pick], linear.direction,
                            linear.lower, linear.upper)

    def add(self, cuts: list[Cut]) -> None:
        """Add linear bounds."""
        self._program.bound(*_arrays(cuts))

    def solve(self) -> tuple[np.ndarray, Solution]:
        """Coefficients and the solver's answer."""
        return self._program.solve(self._solver)


FORMULATIONS = {"reduced": ReducedSegments, "full": FullSegments}
