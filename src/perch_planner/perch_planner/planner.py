"""The perching planner: quadratic programs until every limit is proved, or a typed refusal. [M:IV-C]

For given durations a QP is solved and its plan checked; where a limit is violated, linear bounds are added and the QP is
solved again; where that does not help, the durations grow [M:IV-C.3]. Where no longer time helps, others are drawn.
Each loop is bounded: a search ends after `iterations_max` programs, and the drawing as well. The procedure as the paper
has it: `paper.paper_m`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from time import perf_counter

import numpy as np

from perch_core.trajectory import FlatTrajectory
from perch_core.values import Certificate
from perch_core.vehicle import Vehicle
from perch_planner import refusals, relaxation
from perch_planner.certificates import certificates
from perch_planner.problem import Limits, PerchProblem, PerchSettings
from perch_planner.search import Attempt, Outcome, Search

_PREFERRED = 60  # programs in which a plan that keeps the rotors' limits must be found where they are preferred


@dataclass(frozen=True, slots=True)
class PerchPlan:
    """A plan whose limits are proved.

    Attributes:
        trajectory: flat outputs, degree 14, from time 0 to contact.
        certificates: one for each limit; that of the rotors is sampled, and may not hold where they are `preferred`.
        iterations: QPs solved.
        solve_time: wall-clock time [s].
        attempts: what was tried on the way, in order.
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
        A plan that keeps every limit, each with its proof; that of the single rotors is sampled, and may be broken where
        they are `preferred` (its certificate says so).

    Raises:
        PerchRefusal: there is none, or none was found; with the violated constraint and its margin.
    """
    begin = perf_counter()
    limits = Limits.of(settings, vehicle)
    refusals.refuse_hopeless(problem, settings, limits, vehicle)
    search, durations, outcome = _search(problem, settings, vehicle, limits)
    if not outcome.proved:
        again = Search(problem, search.settings, vehicle, search.limits)
        restarted = again.restarted()
        search.attempts += again.attempts
        if restarted is None:
            raise relaxation.refusal(search, outcome)
        outcome = restarted
    elif settings.minimum_time:
        outcome = search.shortest(durations, outcome)
    duration = float(outcome.durations.sum())
    if duration > settings.duration_max:
        raise refusals.too_long(settings, duration, certificates(outcome.results, limits, vehicle.mass), search.iterations)
    trajectory = FlatTrajectory(outcome.durations, np.concatenate([outcome.coefficients, outcome.yaw[:, None]], axis=1))
    proofs = certificates(outcome.results, limits, vehicle.mass)
    return PerchPlan(trajectory, proofs, search.iterations, perf_counter() - begin, tuple(search.attempts))


def _search(problem: PerchProblem, settings: PerchSettings, vehicle: Vehicle,
            limits: Limits) -> tuple[Search, np.ndarray, Outcome]:
    """The search, its durations and its outcome; where the rotors' limits are preferred and none is soon found, without them."""
    if settings.rotors != "preferred":
        search = Search(problem, settings, vehicle, limits)
        return search, *search.run()
    first = Search(problem, replace(settings, iterations_max=min(_PREFERRED, settings.iterations_max)), vehicle, limits)
    durations, outcome = first.run()
    if outcome.proved:
        return first, durations, outcome
    search = Search(problem, settings, vehicle, limits.without("rotor_thrust"))
    search.attempts += first.attempts
    return search, *search.run()
