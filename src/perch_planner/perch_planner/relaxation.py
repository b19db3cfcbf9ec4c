"""Diagnosis of a failed search: a small set of limits whose relaxation admits a plan, and by how much to relax them.

Only limits that acted on the search can be the cause: the search is the same without any other. Limits whose removal alone may
suffice are removed one at a time: first those that a caller can change, then the range of the single rotors, which binds before
other limits of the vehicle. Where no single one suffices, all are removed, and restored one by one where a plan keeps them (the
deletion filter of Chinneck and Dravnieks, 1991). Bisection reduces the relaxation. The reported values are kept by a plan.
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
from perch_planner.search import Outcome, Search

PROGRAMS = 170
"""Greatest number of quadratic programs in all searches with relaxed limits."""
_EACH = 30       # of one of them
_TRIALS = 3      # of values: what the plan took of a limit, then halves of the logarithm
_LEAST = 1 / 64  # of what a plan takes beyond a limit that was taken away; less is not tried


class _Limit(NamedTuple):
    """A limit that a trial can relax.

    Attributes:
        free: value of the setting that removes the limit.
        code: refusal code where this limit is the cause.
        words, unit: its name and unit in messages.
    """

    free: float
    code: str
    words: str
    unit: str = ""


_LIMITS = {
    "height_min": _Limit(-1e4, refusals.BOX, "height limits", "m"),
    "height_max": _Limit(1e4, refusals.BOX, "height limits", "m"),
    "duration_max": _Limit(600.0, refusals.BOX, "duration_max", "s"),
    "speed_max": _Limit(1e3, refusals.BOX, "speed limit", "m/s"),
    "rotor_margin": _Limit(-1e3, refusals.THRUST_FLOOR, "thrust range of the single rotors"),
    "thrust_max": _Limit(1e3, refusals.THRUST_FLOOR, "thrust range [M:eq16]", "N"),
    "thrust_min": _Limit(1e-3, refusals.THRUST_FLOOR, "thrust range [M:eq16]", "N"),
    "body_rate_max": _Limit(1e3, refusals.BODY_RATE, "body-rate limit", "rad/s"),
    "clearance_min": _Limit(-1e3, refusals.BOX, "clearance from the surface until contact", "m"),
    "tangential_speed_max": _Limit(20.0, refusals.INFEASIBLE_WINDOW, "slip over the surface at contact [M:eq14]", "m/s"),
}
_ALONE = ("height_min", "height_max", "duration_max", "speed_max", "rotor_margin")  # tried one at a time


def refusal(search: Search, best: Outcome) -> PerchRefusal:
    """Return a refusal that explains why a search found no plan.

    Args:
        search: the finished search.
        best: the outcome that `Search.run` returned.

    Returns:
        A refusal whose `relaxed` holds settings that admit a plan; it is empty where none was found even without limits.
    """
    settings, vehicle = search.settings, search.vehicle
    asked = _asked(settings, Limits.of(settings, vehicle))
    proofs = perch_certificates(search, best)
    longest = max((attempt.duration for attempt in search.attempts), default=0.0)
    tried = f"{search.iterations} programs up to {longest:.2f} s"
    least, most = vehicle.thrust_min, vehicle.thrust_max
    way = _Trials(search, asked).way()
    if way is None and (guess := float(search.first.sum())) > settings.duration_max:
        return PerchRefusal(refusals.BOX, "duration_max", settings.duration_max - guess,
                            f"no plan within duration_max {settings.duration_max:g} s ({tried}), where the first guess is {guess:.2f} s, nor without "
                            "limits; start nearer, ask for fewer waypoints, or raise duration_max", proofs, search.iterations)
    if way is None:
        return PerchRefusal(refusals.INFEASIBLE_WINDOW, "impact window and tube [M:eq14, M:eq15]", -inf,
                            f"no plan, even without the other limits ({tried}); widen the impact speeds or the tube", proofs,
                            search.iterations)
    name, value = next(iter(way.items()))
    kept = " and ".join(dict.fromkeys(_LIMITS[name].words for name in way))
    first = " and ".join(_said(name, value, least, most) for name, value in way.items())
    return PerchRefusal(_LIMITS[name].code, kept, -abs(value - asked[name]),
                        f"no plan keeps the {kept} ({tried}); with {first} there is one", proofs, search.iterations, way)


def _asked(settings: PerchSettings, limits: Limits) -> dict[str, float]:
    """Return the limits in force by the names of their settings."""
    return {name: getattr(settings, name) for name in _LIMITS} | {
        "thrust_min": limits.thrust[0], "thrust_max": limits.thrust[1], "body_rate_max": limits.body_rate}


def _said(name: str, value: float, least: float, most: float) -> str:
    """Return a value as text; least, most: thrust range of a rotor [N]."""
    beyond = ""
    if name == "thrust_max" and value > 4.0 * most:
        beyond = f" (the vehicle has {4.0 * most:.3g} N)"
    if name == "rotor_margin" and value < 0.0:
        free = value * (most - least)
        beyond = f" (rotors from {least + free:.2f} to {most - free:.2f} N; the vehicle's from {least:.2f} to {most:.2f} N)"
    unit = _LIMITS[name].unit
    return f"{name} {value:g}{' ' + unit if unit else ''}{beyond}"


def _free(names: Iterable[str]) -> dict[str, float]:
    """Return the values that remove limits."""
    return {name: _LIMITS[name].free for name in names}


class _Trials:
    """Searches with relaxed limits, bounded by their total number of programs."""

    def __init__(self, search: Search, asked: dict[str, float]) -> None:
        self._search, self._asked, self._left = search, asked, PROGRAMS
        self._tried: dict[frozenset[str], dict[str, float] | None] = {}

    def _used(self, changes: dict[str, Any]) -> dict[str, float] | None:
        """Return what a plan under changed settings uses of each limit; None where a short search finds no plan."""
        if not changes or self._left <= 0:
            return None
        settings = replace(self._search.settings, minimum_time=False, **changes)
        trial = Search(self._search.problem, settings, self._search.vehicle, Limits.of(settings, self._search.vehicle), min(_EACH, self._left))
        _, outcome = trial.run()
        self._left -= trial.iterations
        return _used(trial.problem, outcome, trial.vehicle) if outcome.proved else None

    def _without(self, names: Iterable[str]) -> dict[str, float] | None:
        """Return what a plan without some limits uses of each limit; None where a short search finds no plan."""
        taken = frozenset(names)
        if taken not in self._tried:
            self._tried[taken] = self._used(_free(names))
        return self._tried[taken]

    def _smallest(self) -> tuple[list[str], dict[str, float]] | None:
        """Return a small set of limits whose removal admits a plan, and the use of that plan; None: no plan without limits."""
        taken = [name for name in _LIMITS if name != "thrust_min"]  # where the thrust may vanish, proofs fail
        used = self._without(taken)  # first, as it takes few programs: what is named where they are used up before fewer limits are tried
        for name in _ALONE:
            if name in self._search.acted and (found := self._without([name])):
                return [name], found
        if not used:
            taken = list(_LIMITS)
            if not (used := self._without(taken)):
                return None
        for name in reversed(_LIMITS):
            beyond = self._beyond(taken, used)
            if found := self._without(beyond):
                taken, used = beyond, found
            left = [n for n in taken if n != name]
            if found := self._without(left):
                taken, used = left, found
        return self._beyond(taken, used) or taken, used

    def _beyond(self, names: Iterable[str], used: dict[str, float]) -> list[str]:
        """Return the limits whose requested values a plan violates."""
        return [n for n in names if (used[n] - self._asked[n]) * (_LIMITS[n].free - self._asked[n]) > 0.0]

    def way(self) -> dict[str, float] | None:
        """Return values of limits that admit a plan, as near to the requested ones as bisection finds; None: none exist."""
        if (smallest := self._smallest()) is None:
            return None
        names, used = smallest
        values, low, high, share = self._shares(names, used, 1.0), _LEAST, 2.0, 1.0  # under a limit a plan may need more than it took without
        for _ in range(_TRIALS):
            tried = self._shares(names, used, share)
            if self._used(tried):
                values, high = tried, share
            else:
                low = share
            share = sqrt(low * high)
        return values

    def _shares(self, names: Iterable[str], used: dict[str, float], share: float) -> dict[str, float]:
        """Return limits relaxed by a share of the excess of a plan over them; 1 covers all of it."""
        values = {}
        for name in names:
            asked, free = self._asked[name], _LIMITS[name].free
            values[name] = sorted((asked, _outward(asked, asked + share * (used[name] - asked)), free))[1]
        return values


def _outward(asked: float, value: float) -> float:
    """Round a value to two digits of its difference from the requested one, away from the requested one."""
    if value == asked:
        return value
    unit = 10.0 ** (floor(log10(abs(value - asked))) - 1)
    return round((ceil if value > asked else floor)(value / unit) * unit, 9)


def _used(problem: PerchProblem, outcome: Outcome, vehicle: Vehicle) -> dict[str, float]:
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
