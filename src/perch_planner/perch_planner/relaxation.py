"""Diagnosis of a failed search: a small set of limits whose relaxation admits a plan, and by how much to relax them.

Only limits that influenced the search can be the cause: the search is the same without any other. Limits whose removal alone may
suffice are removed one at a time: first those that a caller can change, then the range of the single rotors, which binds before
other limits of the vehicle. Where no single one suffices, all are removed, and restored one by one where a plan keeps them (the
deletion filter of Chinneck and Dravnieks, 1991). Bisection reduces the relaxation. The reported values are kept by a plan.
Where a plan without some limits keeps all of them, as a search under them may miss it, it is the result.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from math import ceil, floor, inf, log10, sqrt
from typing import Any, NamedTuple

import numpy as np

from perch_core.vehicle import Vehicle
from perch_planner import plan_checks, refusals
from perch_planner.certificates import perch_certificates
from perch_planner.plan_checks import MAXIMUM, MINIMUM
from perch_planner.problem import Limits, PerchProblem, PerchSettings
from perch_planner.refusals import PerchRefusal
from perch_planner.search import Found, Outcome, Search

PROGRAMS_MAX = 600
"""Greatest number of quadratic programs in all searches with relaxed limits."""
_PROGRAMS_PER_TRIAL = 100 # of one of them
_VALUE_TRIALS = 5         # of values: what the plan took of a limit, then halves of the logarithm
_SHARE_MIN = 1 / 64       # of what a plan takes beyond a limit that was removed; less is not tried
_LONGEST_PLAN = 60.0      # [s] of a trial; plans of minutes have hundreds of segments, and each of their programs takes a second
_LONGER_FACTORS = 3.0, 1.5  # of `duration_max` and of the first durations, where a trial may be longer


class _Limit(NamedTuple):
    """A limit that a trial can relax.

    Attributes:
        unlimited: value of the setting that removes the limit.
        code: refusal code where this limit is the cause.
        label, unit: its name and unit in messages.
    """

    unlimited: float
    code: str
    label: str
    unit: str = ""


_LIMITS = {
    "height_min": _Limit(-1e4, refusals.BOX, "height limits", "m"),
    "height_max": _Limit(1e4, refusals.BOX, "height limits", "m"),
    "duration_max": _Limit(600.0, refusals.BOX, "duration_max", "s"),
    "speed_max": _Limit(100.0, refusals.BOX, "speed limit", "m/s"),
    "rotor_margin": _Limit(-1e3, refusals.THRUST_FLOOR, "thrust range of the single rotors"),
    "thrust_max": _Limit(4e3, refusals.THRUST_FLOOR, "thrust range [M:eq16]", "N"),
    "thrust_min": _Limit(1e-3, refusals.THRUST_FLOOR, "thrust range [M:eq16]", "N"),
    "body_rate_max": _Limit(1e4, refusals.BODY_RATE, "body-rate limit", "rad/s"),
    "clearance_min": _Limit(-1e3, refusals.BOX, "clearance from the surface until contact", "m"),
    "tangential_speed_max": _Limit(20.0, refusals.INFEASIBLE_WINDOW, "slip over the surface at contact [M:eq14]", "m/s"),
}
_SINGLE_LIMITS = ("height_min", "height_max", "duration_max", "speed_max", "rotor_margin")  # tried one at a time


def found_by_trial(search: Search, best: Outcome) -> Found:
    """Return a plan that keeps all limits, if a search without some of them finds one.

    Args:
        search: the finished search.
        best: the outcome that `Search.run` returned.

    Raises:
        PerchRefusal: there is none; `relaxed` holds settings that admit a plan, and is empty where none was found even without limits.
    """
    trials = _Trials(search, _requested(search.settings, search.limits))
    relaxed_limits = trials.relaxation()
    if trials.kept is None:
        raise _refusal(search, best, trials.requested, relaxed_limits)
    return trials.kept


def _refusal(search: Search, best: Outcome, requested: dict[str, float], relaxed_limits: dict[str, float] | None) -> PerchRefusal:
    """Return the refusal that explains why a search found no plan."""
    settings, vehicle = search.settings, search.vehicle
    proofs = perch_certificates(search, best)
    longest = max((attempt.duration for attempt in search.attempts), default=0.0)
    tried = f"{search.iterations} programs up to {longest:.2f} s"
    least, most = vehicle.thrust_min, vehicle.thrust_max
    if relaxed_limits is None and (guess := float(search.initial_durations.sum())) > settings.duration_max:
        return PerchRefusal(refusals.BOX, "duration_max", settings.duration_max - guess,
                            f"no plan within duration_max {settings.duration_max:g} s ({tried}), where the first guess is {guess:.2f} s, nor without "
                            "limits; start nearer, request fewer waypoints, or raise duration_max", proofs, search.iterations)
    if relaxed_limits is None:
        return PerchRefusal(refusals.INFEASIBLE_WINDOW, "impact window and tube [M:eq14, M:eq15]", -inf,
                            f"no plan, even without the other limits ({tried}); widen the impact speeds or the tube", proofs,
                            search.iterations)
    name, value = next(iter(relaxed_limits.items()))
    names = " and ".join(dict.fromkeys(_LIMITS[name].label for name in relaxed_limits))
    values = " and ".join(_format(name, value, least, most) for name, value in relaxed_limits.items())
    return PerchRefusal(_LIMITS[name].code, names, -abs(value - requested[name]),
                        f"no plan keeps the {names} ({tried}); with {values} there is one", proofs, search.iterations, relaxed_limits)


def _requested(settings: PerchSettings, limits: Limits) -> dict[str, float]:
    """Return the limits in force by the names of their settings; none is looser than the value that removes it."""
    return {name: getattr(settings, name) for name in _LIMITS} | {
        "thrust_min": max(limits.thrust[0], _LIMITS["thrust_min"].unlimited), "thrust_max": limits.thrust[1], "body_rate_max": limits.body_rate}


def _format(name: str, value: float, least: float, most: float) -> str:
    """Return a value as text; least, most: thrust range of a rotor [N]."""
    note = ""
    if name == "thrust_max" and value > 4.0 * most:
        note = f" (the vehicle has {4.0 * most:.3g} N)"
    if name == "rotor_margin" and value < 0.0:
        margin = value * (most - least)
        note = f" (rotors from {least + margin:.2f} to {most - margin:.2f} N; the vehicle's from {least:.2f} to {most:.2f} N)"
    unit = _LIMITS[name].unit
    return f"{name} {value:g}{' ' + unit if unit else ''}{note}"


class _Trials:
    """Searches with relaxed limits, bounded by their total number of programs."""

    def __init__(self, search: Search, requested: dict[str, float]) -> None:
        self._search, self.requested, self._programs_left = search, requested, PROGRAMS_MAX
        self.kept: Found | None = None
        """A plan of a trial that keeps all requested limits; it ends the trials."""
        longest = max(_LONGEST_PLAN, _LONGER_FACTORS[0] * requested["duration_max"], _LONGER_FACTORS[1] * float(search.initial_durations.sum()))
        self._unlimited = {name: limit.unlimited for name, limit in _LIMITS.items()}
        self._unlimited["duration_max"] = min(longest, self._unlimited["duration_max"])
        self._tried: dict[frozenset[str], dict[str, float] | None] = {}

    def _usage_under(self, changes: dict[str, Any]) -> dict[str, float] | None:
        """Return what a plan under changed settings uses of each limit; None where a short search finds no plan."""
        if not changes or self._programs_left <= 0 or self.kept is not None:
            return None
        settings = replace(self._search.settings, minimum_time=False, **changes)
        trial = Search(self._search.problem, settings, self._search.vehicle, Limits.of(settings, self._search.vehicle),
                       min(_PROGRAMS_PER_TRIAL, self._programs_left))
        found = trial.run()
        self._programs_left -= trial.iterations
        if not found.outcome.proved:
            return None
        used = _limit_usage(trial.problem, found.outcome, trial.vehicle)
        # A slip within its limit on time may not be so for a late contact.
        if "tangential_speed_max" not in changes and not self._violated(_LIMITS, used):
            self.kept = found
        return used

    def _usage_without(self, names: Iterable[str]) -> dict[str, float] | None:
        """Return what a plan without some limits uses of each limit; None where a short search finds no plan."""
        removed = frozenset(names)
        if removed not in self._tried:
            self._tried[removed] = self._usage_under({name: value for name, value in self._unlimited.items() if name in removed})
        return self._tried[removed]

    def _smallest_removal(self) -> tuple[list[str], dict[str, float]] | None:
        """Return a small set of limits whose removal admits a plan, and the use of that plan; None: no plan without limits."""
        removed = [name for name in _LIMITS if name != "thrust_min"]  # where the thrust may vanish, proofs fail
        used = self._usage_without(removed)  # first, as it takes few programs: the result where they are used up before fewer limits are tried
        for name in _SINGLE_LIMITS:
            if name in self._search.active_limits and (found := self._usage_without([name])):
                return [name], found
        if not used:
            removed = list(_LIMITS)
            if not (used := self._usage_without(removed)):
                return None
        for name in reversed(_LIMITS):
            violated = self._violated(removed, used)
            if found := self._usage_without(violated):
                removed, used = violated, found
            fewer = [n for n in removed if n != name]
            if found := self._usage_without(fewer):
                removed, used = fewer, found
        return self._violated(removed, used) or removed, used

    def _violated(self, names: Iterable[str], used: dict[str, float]) -> list[str]:
        """Return the limits whose requested values a plan violates."""
        return [n for n in names if (used[n] - self.requested[n]) * (self._unlimited[n] - self.requested[n]) > 0.0]

    def relaxation(self) -> dict[str, float] | None:
        """Return values of limits that admit a plan, as near to the requested ones as bisection finds; None: none exist."""
        if (smallest := self._smallest_removal()) is None:
            return None
        names, used = smallest
        if names == ["rotor_margin"] and self.requested["rotor_margin"] > 0.0 > used["rotor_margin"] and (found := self._usage_under({"rotor_margin": 0.0})):
            used = found | {"rotor_margin": 0.0}  # within the range of the rotors: the plan without any range takes more than is needed
        values, low, high, share = self._relaxed_limits(names, used, 1.0), _SHARE_MIN, 2.0, 1.0  # under a limit a plan may need more than it took without
        for _ in range(_VALUE_TRIALS):
            tried = self._relaxed_limits(names, used, share)
            if self._usage_under(tried):
                values, high = tried, share
            else:
                low = share
            share = sqrt(low * high)
        return values

    def _relaxed_limits(self, names: Iterable[str], used: dict[str, float], share: float) -> dict[str, float]:
        """Return limits relaxed by a share of the excess of a plan over them; 1 covers all of it."""
        values = {}
        for name in names:
            requested, unlimited = self.requested[name], self._unlimited[name]
            values[name] = sorted((requested, _round_away(requested, requested + share * (used[name] - requested)), unlimited))[1]
        return values


def _round_away(requested: float, value: float) -> float:
    """Round a value to two digits of its difference from the requested one, away from the requested one."""
    if value == requested:
        return value
    unit = 10.0 ** (floor(log10(abs(value - requested))) - 1)
    return round((ceil if value > requested else floor)(value / unit) * unit, 9)


def _limit_usage(problem: PerchProblem, outcome: Outcome, vehicle: Vehicle) -> dict[str, float]:
    """Return what a plan uses of each limit, by the names of their settings."""
    rows = dict(zip(plan_checks.NAMES, outcome.results))
    last, T = outcome.coefficients[-1], outcome.durations[-1]
    v = (last.shape[1] - 1) * (last[:, -1] - last[:, -2]) / T - problem.target_velocity
    s3, mass, least, most = problem.surface.normal, vehicle.mass, vehicle.thrust_min, vehicle.thrust_max
    rotors = rows["rotor_thrust"]
    return {"thrust_max": mass * rows["thrust"][MAXIMUM], "thrust_min": mass * rows["thrust"][MINIMUM],
            "height_min": rows["height"][MINIMUM], "height_max": rows["height"][MAXIMUM],
            "body_rate_max": rows["body_rate"][MAXIMUM], "speed_max": rows["speed"][MAXIMUM],
            "duration_max": float(outcome.durations.sum()), "clearance_min": rows["clearance"][MINIMUM],
            "tangential_speed_max": float(np.linalg.norm(v - (v @ s3) * s3)),
            "rotor_margin": min(rotors[MINIMUM] - least, most - rotors[MAXIMUM]) / (most - least)}
