"""The perching planner: quadratic programs until every limit is proved, or a typed refusal. [M:IV-C]

For given durations a QP is solved and its plan checked; where a limit is violated, linear bounds are added and the QP is
solved again; where that does not help, the durations grow [M:IV-C.3] and the approach is divided more finely. Each loop is
bounded: a search ends after `search.ITERATIONS_MAX` programs. `paper.paper_m` is the procedure as printed.
"""

from __future__ import annotations

from dataclasses import dataclass
from time import perf_counter

import numpy as np

from perch_core.trajectory import FlatTrajectory
from perch_core.values import Certificate
from perch_core.vehicle import Vehicle
from perch_planner import refusals, relaxation
from perch_planner.certificates import perch_certificates
from perch_planner.problem import Limits, PerchProblem, PerchSettings
from perch_planner.search import Attempt, Search


@dataclass(frozen=True, slots=True)
class PerchPlan:
    """A plan whose limits are proved.

    Attributes:
        trajectory: flat outputs, degree 14, from time 0 to contact.
        certificates: one for each limit.
        iterations: QPs solved.
        solve_time: wall-clock time [s].
        attempts: quadratic programs of the search, in order.
    """

    trajectory: FlatTrajectory
    certificates: tuple[Certificate, ...]
    iterations: int
    solve_time: float
    attempts: tuple[Attempt, ...]

    @property
    def duration(self) -> float:
        """Time to contact [s]."""
        return self.trajectory.duration


def plan(problem: PerchProblem, settings: PerchSettings, vehicle: Vehicle) -> PerchPlan:
    """Plan a perch. [M:IV-C]

    Args:
        problem: start, surface, waypoints, target velocity.
        settings: parameters of the planner.
        vehicle: mass, thrust range, extension and perch offset.

    Returns:
        A plan that keeps every limit, each with its proof.

    Raises:
        PerchRefusal: no plan exists or was found; carries the violated constraint and its margin.
    """
    begin, settings = perf_counter(), settings.for_surface(problem.surface)
    limits = Limits.of(settings, vehicle)
    refusals.check_feasibility(problem, settings, limits, vehicle)
    search = Search(problem, settings, vehicle, limits)
    found = search.run()
    if not found.outcome.proved:
        found = relaxation.found_by_trial(search, found.outcome)
    outcome = search.shortest(found) if settings.minimum_time else found.outcome
    trajectory = FlatTrajectory(outcome.durations, np.concatenate([outcome.coefficients, outcome.yaw[:, None]], axis=1))
    return PerchPlan(trajectory, perch_certificates(search, outcome), search.iterations, perf_counter() - begin, tuple(search.attempts))
