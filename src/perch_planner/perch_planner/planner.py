"""The perching planner: quadratic programs until every limit is proved, or a typed refusal. [M:IV-C]

For given durations a QP is solved and its plan checked; where a limit is violated, linear bounds are added and the QP is
solved again; where that does not help, the durations grow [M:IV-C.3]. Each of the three loops is bounded, so that a plan
ends after at most `iterations_max` programs. The procedure as the paper has it: `paper.paper_m`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from time import perf_counter

import numpy as np

from perch_core.trajectory import FlatTrajectory
from perch_core.values import Certificate
from perch_core.vehicle import Vehicle
from perch_planner import plan_checks, refusals
from perch_planner.certificates import certificates
from perch_planner.problem import Limits, PerchProblem, PerchSettings
from perch_planner.refusals import PerchRefusal
from perch_planner.search import Attempt, Outcome, Search

_PREFERRED = 60  # programs in which a plan that keeps the rotors' limits must be found where they are preferred
_CODES = {"": refusals.INFEASIBLE_WINDOW, "thrust": refusals.THRUST_FLOOR, "speed": refusals.BOX, "height": refusals.BOX,
          "clearance": refusals.BOX, "body_rate": refusals.BODY_RATE, "rotor_thrust": refusals.THRUST_FLOOR,
          "solver": refusals.SOLVER}
_WORDS = {"": "impact window and tube [M:eq14, M:eq15]", "thrust": "thrust range [M:eq16]", "speed": "speed limit",
          "height": "height limits", "clearance": "clearance from the surface until contact", "body_rate": "body-rate limit",
          "rotor_thrust": "thrust range of the single rotors",
          "solver": "numerics of the quadratic program"}
_ADVICE = {"": "widen the impact speeds, tangential_speed_max or the tube",
           "thrust": "raise thrust_max, tangential_speed_max or duration_max, or lower impact_acceleration",
           "speed": "raise speed_max", "height": "move the target or the start, or widen the height limits",
           "clearance": "start farther in front of the surface", "body_rate": "raise body_rate_max or impact_acceleration",
           "rotor_thrust": "raise impact_acceleration or tube_tolerance, or shorten tube_time",
           "solver": "choose another solver"}


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
        raise _refusal(search, outcome)
    if settings.minimum_time:
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


def _refusal(search: Search, best: Outcome) -> PerchRefusal:
    """Find out what stands in the way: each limit that failed is taken away, then several, until there is a plan."""
    asked = Limits.of(search.settings, search.vehicle)
    proofs = () if best.results is None else certificates(best.results, asked, search.vehicle.mass)
    longest = search.attempts[-1].duration if search.attempts else float(search.first.sum())
    tried = f"{search.iterations} programs up to {longest:.2f} s"
    alone = {(name,): Search(search.problem, search.settings, search.vehicle, search.limits.without(name))
             for name in _failed(search)}
    for taken, relaxed in alone.items():
        _, outcome = relaxed.run()
        if outcome.proved:
            return _named(search, taken, outcome, asked, proofs, tried)
    taken, relaxed = next(iter(alone.items()), ((), search))
    while name := next((n for n in _failed(relaxed) if n not in taken), None):
        taken += (name,)
        relaxed = Search(search.problem, search.settings, search.vehicle, relaxed.limits.without(name))
        _, outcome = relaxed.run()
        if outcome.proved:
            return _named(search, taken, outcome, asked, proofs, tried)
    name = "solver" if search.failures["solver"] else ""
    return PerchRefusal(_CODES[name], _WORDS[name], float("-inf"),
                        f"{_WORDS[name]}: no plan, even without the other limits ({tried}); {_ADVICE[name]}", proofs,
                        search.iterations)


def _failed(search: Search) -> list[str]:
    """Names of the limits that failed in a search, the most frequent first."""
    return [name for name, _ in search.failures.most_common() if name in plan_checks.NAMES]


def _named(search: Search, taken: tuple[str, ...], outcome: Outcome, asked: Limits, proofs: tuple[Certificate, ...],
           tried: str) -> PerchRefusal:
    """The refusal that names the limits without which there is a plan, and what that plan takes."""
    margin, words = _needed(certificates(outcome.results, asked, search.vehicle.mass), taken)
    constraint = " and ".join(_WORDS[n] for n in taken)
    return PerchRefusal(_CODES[taken[0]], constraint, margin,
                        f"no plan keeps the {constraint} ({tried}); without it there is one that takes {words}; "
                        f"{_ADVICE[taken[0]]}", proofs, search.iterations, taken)


def _needed(proofs: tuple[Certificate, ...], names: tuple[str, ...]) -> tuple[float, str]:
    """By how much the first named limit is exceeded by a plan without it, and its figures in words."""
    by_name = {proof.quantity: proof for proof in proofs}
    first = by_name[names[0]]
    words = ", ".join(f"{n} in [{by_name[n].minimum:.3g}, {by_name[n].maximum:.3g}] {by_name[n].unit}" for n in names)
    return first.margin, words
