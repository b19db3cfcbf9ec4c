"""The search for a plan: programs, cuts and longer durations until every limit is proved. [M:IV-C.3]"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from perch_core.vehicle import Vehicle
from perch_planner import refusals
from perch_planner.contact_constraints import Contact
from perch_planner.cutting import turning_side
from perch_planner.judgement import Judgement, Question
from perch_planner.linear_bounds import Bounds
from perch_planner.problem import Limits, PerchProblem, PerchSettings, contact_heading
from perch_planner.rotor_thrusts import linear_bounds, rotor_model, sampled
from perch_planner.segment_program import COST_ORDER, SegmentProgram
from perch_planner.time_allocation import SEGMENT_MIN, allocate, lengthen_approach, split_last, stretch_factor, with_last_segment
from perch_planner.yaw_profile import yaw_coefficients

_CUT_ROUNDS = 24
_PATIENCE = 5         # so often, peaks are stretched where a longer time helps most: high ones, and those before the last waypoint
_NEAR = 0.03          # violations of the thrust range below this share are cut together with the other limits
_PLAIN_STRETCH = 1.15
_BISECTIONS = 12
_RESTARTS = 40        # draws of durations where lengthening the first ones has led to no plan


class Attempt(NamedTuple):
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


class Outcome(NamedTuple):
    """What a set of durations [s] gave: a plan whose limits are proved, or one whose are not, and how much longer to try."""

    durations: np.ndarray
    coefficients: np.ndarray | None
    yaw: np.ndarray | None
    results: np.ndarray | None
    proved: bool = False
    stretch: float = _PLAIN_STRETCH
    extrema: np.ndarray | None = None


class Search:
    """State of one planning call."""

    def __init__(self, problem: PerchProblem, settings: PerchSettings, vehicle: Vehicle, limits: Limits) -> None:
        self.problem, self.settings, self.vehicle, self.limits = problem, settings, vehicle, limits
        self.low, self.high = limits.thrust[0] / vehicle.mass, limits.thrust[1] / vehicle.mass
        self.contact = Contact(problem, settings, vehicle.perch_offset)
        self.first = allocate(problem, settings, self.contact.points)
        self.end_yaw = contact_heading(problem.surface)
        self.question = Question(
            problem.surface.p_WS, problem.target_velocity, problem.surface.normal.copy(), turning_side(self.end_yaw), self.low,
            self.high, limits.speed, *limits.height, limits.extension, limits.clearance, limits.body_rate, _NEAR * self.high,
            len(problem.waypoints))
        self.rotors = rotor_model(vehicle)
        self.attempts: list[Attempt] = []

    @property
    def iterations(self) -> int:
        return len(self.attempts)

    def try_durations(self, durations: np.ndarray, patient: bool = False) -> Outcome:
        """Solve and cut for fixed durations until every limit is proved or nothing helps.

        Args:
            durations: [s], shape (f,).
            patient: give up early where longer durations promise more than cuts.
        """
        settings, start = self.settings, self.problem.start
        nothing = Outcome(durations, None, None, None)
        try:
            program = SegmentProgram(self.contact, durations, settings, self.question)
        except np.linalg.LinAlgError:
            return nothing
        yaw = yaw_coefficients(start.yaw, start.yaw_rate, start.yaw_acc, self.end_yaw, durations,
                               COST_ORDER[settings.objective])
        best, count, turning, duration = None, 0, False, float(durations.sum())
        for rounds in range(_CUT_ROUNDS + 1):
            if rounds and self.iterations >= settings.iterations_max:
                break
            found = program.judged(yaw, patient, rounds > 0)
            if found is None:
                self._note(duration, np.nan, np.nan, count)
                break
            self._note(duration, found.least, found.most, count)
            outcome = self._thrust(durations, found)
            if found.stretch:
                return outcome
            count += found.cuts
            if found.checked:
                low, high = self.limits.rotor_thrust
                thrusts, row = sampled(found.coefficients, yaw, durations, *self.rotors)
                kept = low <= row[0] and row[2] <= high
                results, turning = np.vstack([found.results, [*row, kept]]), turning or not kept
                if found.holds and kept:
                    return Outcome(durations, found.coefficients, yaw, results, True)
                if turning:
                    bounds = Bounds(*linear_bounds(thrusts, row, found.coefficients, yaw, durations, low, high, *self.rotors))
                    program.replace(bounds)
                    count += len(bounds.lower)
                outcome = outcome or Outcome(durations, found.coefficients, yaw, results)
            best = outcome
            if not (found.cuts or turning):
                break
        # After cuts the peak says nothing about a longer plan: the next one is only a little longer.
        return best._replace(stretch=_PLAIN_STRETCH) if best and count else best or nothing

    def _thrust(self, durations: np.ndarray, found: Judgement) -> Outcome | None:
        """The outcome where the thrust leaves its range, or None."""
        if found.most <= self.high and found.least >= self.low:
            return None
        return Outcome(durations, found.coefficients, None, None, stretch=stretch_factor(found.most, self.high), extrema=found.extrema)

    def _note(self, duration: float, least: float, most: float, cuts: int) -> None:
        mass = self.vehicle.mass
        self.attempts.append(Attempt(duration, mass * least, mass * most, cuts))

    def run(self) -> tuple[np.ndarray, Outcome]:
        """Lengthen until every limit is proved, or the time or the number of programs is used up.

        Raises:
            PerchRefusal: the first durations are longer than `duration_max` already.
        """
        durations, best, stretched = self.first, None, 0
        if not self.settings.minimum_time and float(durations.sum()) > self.settings.duration_max:  # they only grow
            raise refusals.too_long(self.settings, float(durations.sum()))
        while True:
            outcome = self.try_durations(split_last(durations), patient=stretched < _PATIENCE)
            if outcome.proved:
                return durations, outcome
            stretched += 1
            if best is None or outcome.results is not None:
                best = outcome
            grown = self.longer(durations, outcome)
            if grown.sum() > self.settings.duration_max or self.iterations >= self.settings.iterations_max:
                return durations, best
            durations = grown

    def restarted(self) -> Outcome | None:
        """Other divisions of the way and of the time, drawn around the first durations: a plan, or None.

        The drawing is seeded: the same problem has the same answer.
        """
        rng = np.random.default_rng(0)
        for _ in range(_RESTARTS):
            if self.iterations >= self.settings.iterations_max:
                break
            durations = self.first * np.exp(rng.uniform(-0.5, 1.2)) * np.exp(rng.normal(0.0, 0.25, len(self.first)))
            pieces = np.exp(rng.normal(0.0, 0.5, rng.integers(1, 6)))
            pieces *= durations[-1] / pieces.sum()
            pieces[-1] = max(pieces[-1], self.settings.tube_time, self.settings.last_segment_min)
            durations = np.append(durations[:-1], pieces)
            if durations.min() >= SEGMENT_MIN and durations.sum() <= self.settings.duration_max:
                outcome = self.try_durations(durations, patient=True)
                if outcome.proved:
                    return outcome
        return None

    def longer(self, durations: np.ndarray, outcome: Outcome) -> np.ndarray:
        """The next durations: all are longer where the thrust fails before the last waypoint, else the approach. [M:IV-C.3]

        Args:
            durations: of the problem's segments, shape (waypoints + 1,).
            outcome: what they gave.
        """
        before = None if outcome.extrema is None else outcome.extrema[:len(durations) - 1]
        early = before is not None and ((before[:, 4] > self.high) | (before[:, 1] < self.low)).any()
        grown = outcome.stretch * durations if early else lengthen_approach(durations)
        return with_last_segment(grown, self.settings)

    def shortest(self, durations: np.ndarray, outcome: Outcome) -> Outcome:
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
        return outcome
