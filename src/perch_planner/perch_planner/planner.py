"""The perching planner: quadratic programs until every limit is proved, or a typed refusal. [M:IV-C]

For given durations a QP [M:eq8] is solved and its plan checked; where a limit is violated, linear bounds are added and
the QP is solved again (`settings.cuts`); where that does not help, the durations grow [M:IV-C.3]. Each of the three
loops is bounded, so that a plan ends after at most `iterations_max` programs.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from time import perf_counter

import numpy as np

from perch_core.trajectory import FlatTrajectory
from perch_core.vehicle import Vehicle
from perch_planner import plan_checks, refusals, sturm
from perch_planner.certificates import Certificate, certificates
from perch_planner.contact_constraints import Contact
from perch_planner.cutting import limit_cuts, thrust_cuts, turning_side
from perch_planner.problem import Limits, PerchProblem, PerchSettings, contact_heading
from perch_planner.refusals import PerchRefusal
from perch_planner.segment_program import COST_ORDER, FORMULATIONS
from perch_planner.time_allocation import allocate, lengthen_approach, split_last, stretch_factor, with_last_segment
from perch_planner.yaw_profile import yaw_coefficients

_CUT_ROUNDS = 24
_CUT_REACH = 1.7      # peaks beyond this multiple of the limit are stretched first,
_NEAR = 0.03          # violations of the thrust range below this share are cut together with the other limits
_PATIENCE = 5         # and so are peaks before the last waypoint, where a longer time helps most; so many times
_PLAIN_STRETCH = 1.15
_SEGMENT_STRETCH = 1.1  # of the paper's per-segment stretching
_BISECTIONS = 12


@dataclass(frozen=True, slots=True)
class Attempt:
    """One quadratic program on the way to a plan.

    Attributes:
        duration: of the whole plan [s].
        thrust_min, thrust_max: proved extrema of the collective thrust [N]; nan where the program had no solution.
        cuts: linear bounds in the program.
    """

    duration: float
    thrust_min: float
    thrust_max: float
    cuts: int


@dataclass(frozen=True, slots=True)
class PerchPlan:
    """A plan whose limits are proved.

    Attributes:
        trajectory: flat outputs, degree 14, from time 0 to contact.
        certificates: one for each limit.
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


@dataclass(frozen=True, slots=True)
class _Outcome:
    """What a set of durations gave: a plan (`failure` empty) or why not, and how much longer to try."""

    coefficients: np.ndarray | None
    yaw: np.ndarray | None
    results: np.ndarray | None
    failure: str = ""
    margin: float = 0.0
    stretch: float = _PLAIN_STRETCH
    segments: np.ndarray | None = None

    @property
    def proved(self) -> bool:
        """All limits hold."""
        return not self.failure and self.results is not None


_CODES = {"": refusals.INFEASIBLE_WINDOW, "thrust": refusals.THRUST_FLOOR, "speed": refusals.BOX, "height": refusals.BOX,
          "clearance": refusals.BOX, "body_rate": refusals.BODY_RATE, "solver": refusals.SOLVER}
_WORDS = {"": "impact window and tube [M:eq14, M:eq15]", "thrust": "thrust range [M:eq16]", "speed": "speed limit",
          "height": "height limits", "clearance": "clearance from the surface until contact", "body_rate": "body-rate limit",
          "solver": "numerics of the quadratic program"}
_ADVICE = {"": "widen the impact speeds, tangential_speed_max or the tube",
           "thrust": "raise thrust_max, tangential_speed_max or duration_max, or lower impact_acceleration",
           "speed": "raise speed_max", "height": "move the target or the start, or widen the height limits",
           "clearance": "start farther in front of the surface", "body_rate": "raise body_rate_max or impact_acceleration",
           "solver": "choose another solver"}


class _Search:
    """State of one planning call."""

    def __init__(self, problem: PerchProblem, settings: PerchSettings, vehicle: Vehicle, limits: Limits) -> None:
        self.problem, self.settings, self.vehicle, self.limits = problem, settings, vehicle, limits
        self.low, self.high = (x / vehicle.mass for x in limits.thrust)
        self.contact = Contact(problem, settings, vehicle.perch_offset)
        self.first = allocate(problem, settings, self.contact.p_contact)
        self.end_yaw = contact_heading(problem.surface)
        self.attempts: list[Attempt] = []
        self.failures: Counter[str] = Counter()

    @property
    def iterations(self) -> int:
        return len(self.attempts)

    def try_durations(self, durations: np.ndarray, patient: bool = False) -> _Outcome:
        """Solve and cut for fixed durations until every limit is proved or nothing helps.

        Args:
            durations: [s], shape (f,).
            patient: give up early where longer durations promise more than cuts.
        """
        settings, start = self.settings, self.problem.start
        try:
            program = FORMULATIONS[settings.formulation](self.contact, durations, settings)
        except np.linalg.LinAlgError:
            return _Outcome(None, None, None, "solver")
        yaw = yaw_coefficients(start.yaw, start.yaw_rate, start.yaw_acc, self.end_yaw, durations,
                               COST_ORDER[settings.objective])
        best, count = None, 0
        for rounds in range(_CUT_ROUNDS + 1):
            if rounds and self.iterations >= settings.iterations_max:
                break
            coefficients, solution = program.solve()
            if not solution.solved:
                self._note(durations, None, count)
                break
            extrema = plan_checks.thrust_extrema(coefficients, durations, self.low, self.high)
            self._note(durations, extrema, count)
            outcome, cuts = self._thrust(coefficients, durations, extrema)
            if outcome and (not settings.cuts or patient and self._better_stretched(extrema)):
                return outcome
            if not outcome or rounds and outcome.margin > -_NEAR * self.limits.thrust[1]:
                results, where = self._check(coefficients, yaw, durations)
                if results[:, plan_checks.HOLDS].all():
                    return _Outcome(coefficients, yaw, results)
                cuts += limit_cuts(where, coefficients, durations, self.problem, self.limits)
                outcome = outcome or self._limit(coefficients, yaw, results)
            best = outcome
            if not cuts or not settings.cuts:
                break
            program.add(cuts)
            count += len(cuts)
        # After cuts the peak says nothing about a longer plan: the next one is only a little longer.
        return replace(best, stretch=_PLAIN_STRETCH) if best and count else best or _Outcome(None, None, None)

    def _thrust(self, coefficients: np.ndarray, durations: np.ndarray, extrema: np.ndarray):
        """The failure of the thrust range, or None, and cuts against it."""
        peak, least = float(extrema[:, 4].max()), float(extrema[:, 1].min())
        if peak <= self.high and least >= self.low:
            return None, []
        margin = min(self.high - peak, least - self.low) * self.vehicle.mass
        outside = (extrema[:, 4] > self.high) | (extrema[:, 1] < self.low)
        outcome = _Outcome(coefficients, None, None, "thrust", margin, stretch_factor(peak, self.high), outside)
        if not self.settings.cuts:
            return outcome, []
        return outcome, thrust_cuts(coefficients, durations, extrema, self.low, self.high, turning_side(self.problem))

    def _better_stretched(self, extrema: np.ndarray) -> bool:
        """Whether the peak lies where a longer time lowers it."""
        segment = int(extrema[:, 4].argmax())
        peak = extrema[segment, 4]
        return bool(peak > self.high and (segment < len(self.problem.waypoints) or peak > _CUT_REACH * self.high))

    def _limit(self, coefficients: np.ndarray, yaw: np.ndarray, results: np.ndarray) -> _Outcome:
        """The failure of another limit than the thrust range."""
        name = [n for n, row in zip(plan_checks.NAMES, results) if not row[plan_checks.HOLDS]][-1]
        return _Outcome(coefficients, yaw, results, name, self._margin(results, name))

    def _check(self, coefficients: np.ndarray, yaw: np.ndarray, durations: np.ndarray):
        surface, limits = self.problem.surface, self.limits
        return plan_checks.check(coefficients, yaw, durations, surface.p_WS, self.problem.target_velocity,
                                 np.ascontiguousarray(surface.normal), self.low, self.high, limits.speed,
                                 limits.height[0], limits.height[1], limits.extension, limits.clearance,
                                 limits.body_rate)

    def _margin(self, results: np.ndarray, name: str) -> float:
        row, limits = results[plan_checks.NAMES.index(name)], self.limits
        if name == "speed":
            return limits.speed - row[plan_checks.MAXIMUM]
        if name == "height":
            return min(row[plan_checks.MINIMUM] - limits.height[0], limits.height[1] - row[plan_checks.MAXIMUM])
        return -float("inf")

    def _note(self, durations: np.ndarray, extrema: np.ndarray | None, cuts: int) -> None:
        mass = self.vehicle.mass
        low, high = (np.nan, np.nan) if extrema is None else (mass * extrema[:, 1].min(), mass * extrema[:, 4].max())
        self.attempts.append(Attempt(float(durations.sum()), float(low), float(high), cuts))

    def run(self) -> tuple[np.ndarray, _Outcome]:
        """Lengthen until every limit is proved, or the time or the number of programs is used up."""
        durations, best, stretched = self.first, None, 0
        while True:
            outcome = self.try_durations(split_last(durations), patient=stretched < _PATIENCE)
            if outcome.proved:
                return durations, outcome
            stretched += 1
            self.failures[outcome.failure] += 1
            if best is None or best.coefficients is None or (outcome.coefficients is not None and outcome.margin > best.margin):
                best = outcome
            grown = self.longer(durations, outcome)
            if grown.sum() > self.settings.duration_max or self.iterations >= self.settings.iterations_max:
                return durations, best
            durations = grown

    def longer(self, durations: np.ndarray, outcome: _Outcome) -> np.ndarray:
        """The next durations. [M:IV-C.3]

        Args:
            durations: of the problem's segments, shape (waypoints + 1,).
            outcome: what they gave.
        """
        last = len(durations) - 1
        violated = np.zeros(last + 1, bool)
        if outcome.segments is not None:
            for i in np.flatnonzero(outcome.segments):
                violated[min(i, last)] = True
        if self.settings.stretching == "segments" and violated.any():
            grown = np.where(violated, _SEGMENT_STRETCH * durations, durations)
        elif self.settings.stretching == "adaptive" and not violated[:last].any():
            grown = lengthen_approach(durations)
        else:
            grown = outcome.stretch * durations
        return with_last_segment(grown, self.settings)

    def shortest(self, durations: np.ndarray, outcome: _Outcome) -> tuple[np.ndarray, _Outcome]:
        """Bisect the scale of all durations for the shortest plan whose limits are still proved."""
        shortest = max(self.settings.tube_time, self.settings.last_segment_min)
        low, high = min(shortest / durations[-1], 1.0), 1.0
        for _ in range(_BISECTIONS):
            if high - low < 1e-3 or self.iterations >= self.settings.iterations_max:
                break
            middle = 0.5 * (low + high)
            tried = self.try_durations(split_last(middle * durations))
            if tried.proved:
                high, outcome = middle, tried
            else:
                low = middle
        return high * durations, outcome


def plan(problem: PerchProblem, settings: PerchSettings, vehicle: Vehicle) -> PerchPlan:
    """Plan a perch. [M:IV-C]

    Args:
        problem: start, surface, waypoints, target velocity.
        settings: parameters of the planner.
        vehicle: mass, thrust range, extension and perch offset.

    Returns:
        A plan that keeps every limit, each with its proof.

    Raises:
        PerchRefusal: there is none, or none was found; with the violated constraint and its margin.
    """
    begin = perf_counter()
    limits = Limits.of(settings, vehicle)
    refusals.refuse_hopeless(problem, settings, limits, vehicle)
    search = _Search(problem, settings, vehicle, limits)
    durations, outcome = search.run()
    if not outcome.proved:
        raise _refusal(search, outcome)
    if settings.minimum_time:
        durations, outcome = search.shortest(durations, outcome)
    durations = split_last(durations)
    method = "bernstein"
    if settings.decider == "sturm":
        method = "sturm"
        if not sturm.thrust_below(outcome.coefficients, durations, search.high):
            raise PerchRefusal(refusals.SOLVER, "Algorithm 1 [M:alg1]", 0.0,
                               "Sturm's chain does not confirm the thrust bound that subdivision proves",
                               certificates(outcome.results, limits, vehicle.mass), search.iterations)
    trajectory = FlatTrajectory(durations, np.concatenate([outcome.coefficients, outcome.yaw[:, None]], axis=1))
    proofs = certificates(outcome.results, limits, vehicle.mass, method)
    return PerchPlan(trajectory, proofs, search.iterations, perf_counter() - begin, tuple(search.attempts))


def _refusal(search: _Search, best: _Outcome) -> PerchRefusal:
    """Find out what stands in the way: limits are taken away, the most often violated first, until there is a plan."""
    limits, taken = search.limits, []
    proofs = () if best.results is None else certificates(best.results, search.limits, search.vehicle.mass)
    tried = f"{search.iterations} programs up to {search.attempts[-1].duration:.2f} s"
    for name, _ in search.failures.most_common():
        if name not in plan_checks.NAMES:
            continue
        taken.append(name)
        limits = limits.without(name)
        relaxed = _Search(search.problem, search.settings, search.vehicle, limits)
        _, outcome = relaxed.run()
        if outcome.proved:
            needed = certificates(outcome.results, search.limits, search.vehicle.mass)
            margin, words = _needed(needed, taken, search.limits)
            constraint = " and ".join(_WORDS[n] for n in taken)
            return PerchRefusal(_CODES[taken[0]], constraint, margin,
                                f"no plan keeps the {constraint} ({tried}); without it there is one that takes {words}; "
                                f"{_ADVICE[taken[0]]}", proofs, search.iterations)
    name = "solver" if search.failures["solver"] else ""
    return PerchRefusal(_CODES[name], _WORDS[name], float("-inf"),
                        f"{_WORDS[name]}: no plan, even without the other limits ({tried}); {_ADVICE[name]}", proofs,
                        search.iterations)


def _needed(proofs: tuple[Certificate, ...], names: list[str], limits: Limits) -> tuple[float, str]:
    """By how much the first named limit is exceeded by a plan without it, and its figures in words."""
    by_name = {proof.quantity: proof for proof in proofs}
    first = by_name[names[0]]
    margin = min(first.minimum - first.lower_limit, first.upper_limit - first.maximum)
    words = ", ".join(f"{n} in [{by_name[n].minimum:.3g}, {by_name[n].maximum:.3g}] {by_name[n].unit}" for n in names)
    return margin, words
