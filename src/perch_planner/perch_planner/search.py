"""The search for a plan: programs, cuts and longer durations until every limit is proved. [M:IV-C.3]"""

from __future__ import annotations

from dataclasses import replace
from itertools import compress
from typing import NamedTuple

import numpy as np

from perch_core.vehicle import Vehicle
from perch_planner.contact_constraints import Contact
from perch_planner.cutting import turn_direction
from perch_planner.plan_evaluation import PlanLimits
from perch_planner.problem import Limits, PerchProblem, PerchSettings, contact_heading
from perch_planner.reference_element import GRAMS
from perch_planner.rotor_thrusts import rotor_model
from perch_planner.segment_program import COST_ORDER, VIOLATED, solve
from perch_planner.time_allocation import (
    FINE_DIVISIONS, allocate, initial_durations, lengthen_approach, shortened, split_finely, split_last, stretch_factor, with_last_segment)
from perch_planner.yaw_profile import yaw_coefficients

STARTS = ((1.0, 100), (1.25, 75), (0.8, 75), (0.55, 50), (0.45, 40))
"""First durations of a search, as factors of the problem's `segment_times`, then of the allocated ones, and most programs from each."""
ITERATIONS_MAX = sum(programs for _, programs in STARTS)
_PROGRAMS_PER_TRY = 25    # of one set of durations
_EARLY_STRETCHES = 5      # so often, peaks are stretched where a longer time helps most: high ones, and those before the last waypoint
_SMALL_VIOLATION = 0.03   # violations of the thrust range below this share are cut together with the other limits
_DEFAULT_STRETCH = 1.15
_BISECTIONS = 12
_SHORTENING_MAX = 200     # quadratic programs
_COARSE_TRIALS = 3        # so many durations are tried with few last pieces first, which cost least; from the last of them on with all divisions
_SMALL_STEPS = 6          # so often the approach becomes a quarter longer, then by more
_APPROACH_GROWTH = (1.25, 1.6)


class Attempt(NamedTuple):
    """One quadratic program of a search.

    Attributes:
        duration: of the whole plan [s].
        thrust_min, thrust_max: proved extrema of the collective thrust [N]; nan where the program had no solution.
        cuts: number of linear bounds added so far for these durations.
    """

    duration: float
    thrust_min: float
    thrust_max: float
    cuts: int


class Outcome(NamedTuple):
    """Result for a set of durations [s]: a plan, whether its limits are proved, and the factor by which to stretch it.

    Coefficients, yaw and results are empty where there are none.
    """

    durations: np.ndarray
    coefficients: np.ndarray = np.empty((0, 3, 15))
    yaw: np.ndarray = np.empty((0, 15))
    results: np.ndarray = np.empty((0, 5))
    proved: bool = False
    stretch: float = _DEFAULT_STRETCH
    extrema: np.ndarray | None = None


class Found(NamedTuple):
    """Result of a search.

    Attributes:
        durations: of the problem's segments [s], shape (waypoints + 1,).
        fails: number of divisions of the approach that failed, which determines the last division.
        outcome: result for these durations, divided.
    """

    durations: np.ndarray
    fails: int
    outcome: Outcome


def division_index(fails: int) -> int:
    """Index in `FINE_DIVISIONS` of the division of the approach to try after `fails` failures; their number: the coarse division."""
    return len(FINE_DIVISIONS) if fails < _COARSE_TRIALS else (fails - _COARSE_TRIALS) % (len(FINE_DIVISIONS) + 1)


def divided_durations(durations: np.ndarray, fails: int) -> np.ndarray:
    """Durations of the segments to try after `fails` divisions of the approach have failed [s]."""
    return split_last(durations) if division_index(fails) == len(FINE_DIVISIONS) else split_finely(durations, FINE_DIVISIONS[division_index(fails)])


class Search:
    """State of one planning call, which ends after `iterations_max` programs."""

    def __init__(self, problem: PerchProblem, settings: PerchSettings, vehicle: Vehicle, limits: Limits,
                 iterations_max: int = ITERATIONS_MAX) -> None:
        self._iterations_max, self._iterations_end = iterations_max, iterations_max
        self.problem, self.settings, self.vehicle, self.limits = problem, settings, vehicle, limits
        self.low, self.high = limits.thrust[0] / vehicle.mass, limits.thrust[1] / vehicle.mass
        self.contact = Contact(problem, settings, vehicle.perch_offset)
        self._allocated = allocate(problem, settings, self.contact.points)
        self.initial_durations = initial_durations(problem, settings, self._allocated)
        self.end_yaw = contact_heading(problem.surface)
        self.plan_limits = PlanLimits(
            problem.surface.p_WS, problem.target_velocity, problem.surface.normal.copy(), turn_direction(self.end_yaw), self.low,
            self.high, limits.speed, *limits.height, limits.extension, limits.clearance, limits.perch_offset, limits.body_rate, _SMALL_VIOLATION * self.high,
            len(problem.waypoints))
        self.rotors = (*limits.rotor_thrust, *rotor_model(vehicle))
        self.attempts: list[Attempt] = []
        self.active_limits = {"tangential_speed_max", "clearance_min"}
        """Settings whose limits influenced the search: those in the rows of every program, and those that plans violated."""

    @property
    def iterations(self) -> int:
        return len(self.attempts)

    def try_durations(self, durations: np.ndarray, allow_stretch: bool = False) -> Outcome:
        """Solve and cut for fixed durations until every limit is proved or cuts do not help.

        Args:
            durations: [s], shape (f,).
            allow_stretch: stop early where longer durations promise more than cuts.
        """
        start, objective, mass = self.problem.start, self.settings.objective, self.vehicle.mass
        order, duration = COST_ORDER[objective], float(durations.sum())
        yaw = yaw_coefficients(start.yaw, start.yaw_rate, start.yaw_acc, self.end_yaw, durations, order)
        programs_max = min(_PROGRAMS_PER_TRY, max(self._iterations_end - self.iterations, 1))
        try:
            programs, violated, coefficients, extrema, results, (least, most, proved, stretch, cuts) = solve(
                durations, yaw, self.contact.velocity, self.contact.problem, objective == "jerk", GRAMS[order], order, tuple(self.plan_limits),
                self.rotors, allow_stretch, programs_max)
        except np.linalg.LinAlgError:
            return Outcome(durations)
        self.attempts += [Attempt(duration, mass * low, mass * high, int(count)) for low, high, count in programs.tolist()]
        self.active_limits.update(compress(VIOLATED, violated.tolist()))
        if not len(coefficients):
            return Outcome(durations)
        if self.low <= least and most <= self.high:
            return Outcome(durations, coefficients, yaw, results, proved)
        # After cuts the peak does not predict that of a longer plan: the next one is only a little longer.
        factor = stretch_factor(most, self.high)
        if cuts:
            factor = min(factor, _DEFAULT_STRETCH) if stretch else _DEFAULT_STRETCH
        return Outcome(durations, coefficients, stretch=factor, extrema=extrema)

    def run(self) -> Found:
        """Search from each of the first durations in `STARTS` until every limit is proved.

        From each, only longer durations are reached, in which the segments grow differently: where one start misses the durations
        that admit a plan, another may find them.
        """
        found: list[Found] = []
        for factor, programs in STARTS:
            self._iterations_end = min(self.iterations + programs, self._iterations_max)
            first = self._allocated if found else self.initial_durations
            found.append(self._run_from(with_last_segment(factor * first, self.settings)))
            if found[-1].outcome.proved:
                return found[-1]
            if self.iterations >= self._iterations_max:
                break
        return found[0]

    def _run_from(self, durations: np.ndarray) -> Found:
        """Lengthen durations until every limit is proved, or the time or the number of programs is exhausted. [M:IV-C.3]

        Where the thrust leaves its range before the last waypoint, all segments grow; otherwise mainly the approach, from the
        third try on only after all its divisions failed. Longer durations are shortened to `duration_max` once, and tried with
        all divisions, none of which ends early at a peak: nothing longer follows.
        """
        best, stretched, fails, at_maximum, outcome = None, 0, 0, False, Outcome(np.empty(0))
        while True:
            if durations.sum() > self.settings.duration_max:
                self.active_limits.add("duration_max")
                fitted = None if at_maximum else shortened(durations, self.settings)
                if fitted is None:
                    return Found(durations, fails, best or Outcome(durations))
                durations, at_maximum, fails = fitted, True, _COARSE_TRIALS - 1
            allow_stretch = not at_maximum and stretched < _EARLY_STRETCHES
            divided = divided_durations(durations, fails)
            if not np.array_equal(divided, outcome.durations):  # a short approach has only one division
                outcome = self.try_durations(divided, allow_stretch)
            if outcome.proved:
                return Found(durations, fails, outcome)
            if best is None or len(outcome.results):
                best = outcome
            if not at_maximum and self.fails_early(durations, outcome):
                grown, stretched = outcome.stretch * durations, stretched + 1
            elif division_index(fails := fails + 1) < len(FINE_DIVISIONS):
                grown = durations  # the same, with another division
            else:
                grown, stretched = lengthen_approach(durations, _APPROACH_GROWTH[stretched >= _SMALL_STEPS]), stretched + 1
            if self.iterations >= self._iterations_end:
                return Found(durations, fails, best)
            durations = with_last_segment(grown, self.settings)

    def fails_early(self, durations: np.ndarray, outcome: Outcome) -> bool:
        """Whether the thrust leaves its range before the last waypoint.

        Args:
            durations: of the problem's segments, shape (waypoints + 1,).
            outcome: result for these durations.
        """
        if outcome.extrema is None:
            return False
        before = outcome.extrema[:len(durations) - 1]
        return bool(((before[:, 4] > self.high) | (before[:, 1] < self.low)).any())

    def shortest(self, found: Found) -> Outcome:
        """Bisect the duration for the shortest plan whose limits are still proved, in about `_SHORTENING_MAX` programs.

        As under a tighter `duration_max`: the segments are shortened, and every division of the approach is tried.
        """
        durations, fails, outcome = found
        self._iterations_end = self.iterations + _SHORTENING_MAX
        low, high = 0.0, float(durations.sum())
        for _ in range(_BISECTIONS):
            if high - low < 1e-3 * high or self.iterations >= self._iterations_end:
                break
            middle = 0.5 * (low + high)
            tried = self._try_divisions(shortened(durations, replace(self.settings, duration_max=middle)), fails)
            if tried is None:
                low = middle
            else:
                high, outcome = middle, tried
        return outcome

    def _try_divisions(self, durations: np.ndarray | None, first: int) -> Outcome | None:
        """Return a plan with these durations and any division of the approach; that after `first` failures is tried first.

        Each is tried once: that of `first` is also one of the others, and a short approach has only one.
        """
        if durations is None:
            return None
        divisions = [divided_durations(durations, fails) for fails in (first, *range(_COARSE_TRIALS - 1, _COARSE_TRIALS + len(FINE_DIVISIONS)))]
        for divided in {tuple(d.tolist()): d for d in divisions}.values():
            if self.iterations < self._iterations_end:
                tried = self.try_durations(divided)
                if tried.proved:
                    return tried
        return None
