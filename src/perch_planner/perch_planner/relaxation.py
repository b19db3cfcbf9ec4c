"""What stands in the way of a plan: the smallest set of limits whose relaxation gives one, and how little of it.

Only limits that acted on the search can be the cause: without one that did not, it would go the same way. These are taken away one
at a time, in the order of `_LIMITS`: first what a caller can change, last what the vehicle has. The first one without which there is
a plan gives way, and bisection finds how little is enough. Where no limit alone is enough, all are taken away, and put back one by
one where there is a plan with them (the deletion filter of Chinneck and Dravnieks, 1991). Every value that is named was tried: with
it there is a plan.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from math import ceil, floor, inf, log10
from typing import NamedTuple

import numpy as np

from perch_core.vehicle import Vehicle
from perch_planner import plan_checks, refusals
from perch_planner.certificates import certificates
from perch_planner.plan_checks import MAXIMUM, MINIMUM
from perch_planner.problem import Limits, PerchProblem, PerchSettings
from perch_planner.refusals import PerchRefusal
from perch_planner.search import Outcome, Search

_PROGRAMS = 30   # of each search with relaxed limits
_HALVINGS = 4    # of what a limit gives


class _Limit(NamedTuple):
    """A limit by the name of its setting.

    Attributes:
        free: value that takes it away.
        code: of a refusal because of it.
        words, unit: for the message.
    """

    free: float
    code: str
    words: str
    unit: str = ""


_LIMITS = {
    "height_min": _Limit(-1e3, refusals.BOX, "height limits", "m"),
    "height_max": _Limit(1e3, refusals.BOX, "height limits", "m"),
    "duration_max": _Limit(600.0, refusals.BOX, "duration_max", "s"),
    "speed_max": _Limit(1e3, refusals.BOX, "speed limit", "m/s"),
    "thrust_max": _Limit(1e3, refusals.THRUST_FLOOR, "thrust range [M:eq16]", "N"),
    "thrust_min": _Limit(1e-3, refusals.THRUST_FLOOR, "thrust range [M:eq16]", "N"),
    "body_rate_max": _Limit(1e3, refusals.BODY_RATE, "body-rate limit", "rad/s"),
    "clearance_min": _Limit(-1e3, refusals.BOX, "clearance from the surface until contact", "m"),
    "tangential_speed_max": _Limit(20.0, refusals.INFEASIBLE_WINDOW, "slip over the surface at contact [M:eq14]", "m/s"),
    "rotor_margin": _Limit(-1e3, refusals.THRUST_FLOOR, "thrust range of the single rotors"),
}


def refusal(search: Search, best: Outcome) -> PerchRefusal:
    """Why a search found no plan.

    Args:
        search: after its end.
        best: its last outcome.

    Returns:
        A refusal whose `relaxed` are the values of settings with which there is a plan; empty: none was found even without limits.
    """
    settings, vehicle = search.settings, search.vehicle
    asked = _asked(settings, Limits.of(settings, vehicle))
    proofs = () if best.results is None else certificates(best.results, Limits.of(settings, vehicle), vehicle.mass)
    longest = max((attempt.duration for attempt in search.attempts), default=float(search.first.sum()))
    tried = f"{search.iterations} programs up to {longest:.2f} s"
    names = [name for name in _LIMITS if name in search.acted and asked[name] != _LIMITS[name].free]
    least, most = vehicle.thrust_min, vehicle.thrust_max
    ways = (_relaxed(search, asked, (name,)) for name in names)
    way = next((way for way in ways if way), None) or _relaxed(search, asked, _smallest(search, asked))
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
    """The limits that hold, by the names of their settings."""
    return {name: getattr(settings, name) for name in _LIMITS} | {
        "thrust_min": limits.thrust[0], "thrust_max": limits.thrust[1], "body_rate_max": limits.body_rate}


def _said(name: str, value: float, least: float, most: float) -> str:
    """A value in words; least, most: thrust of a rotor [N]."""
    beyond = ""
    if name == "thrust_max" and value > 4.0 * most:
        beyond = f" (the vehicle has {4.0 * most:.3g} N)"
    if name == "rotor_margin" and value < 0.0:
        free = value * (most - least)
        beyond = f" (rotors from {least + free:.2f} to {most - free:.2f} N; the vehicle's from {least:.2f} to {most:.2f} N)"
    unit = _LIMITS[name].unit
    return f"{name} {value:g}{' ' + unit if unit else ''}{beyond}"


def _free(names: Iterable[str]) -> dict[str, float]:
    """Values that take limits away."""
    return {name: _LIMITS[name].free for name in names}


def _outcome(search: Search, changes: dict[str, float]) -> Outcome | None:
    """The plan under changed settings, None where none is soon found."""
    settings = replace(search.settings, iterations_max=_PROGRAMS, minimum_time=False, **changes)
    try:
        _, outcome = Search(search.problem, settings, search.vehicle, Limits.of(settings, search.vehicle)).run()
    except PerchRefusal:
        return None
    return outcome if outcome.proved else None


def _smallest(search: Search, asked: dict[str, float]) -> tuple[str, ...]:
    """Limits without which there is a plan, and none of which can stay; those that give first are put back last."""
    taken = list(_LIMITS)
    if (outcome := _outcome(search, _free(taken))) is None:
        return ()
    used = _used(search.problem, outcome, search.vehicle)
    beyond = [name for name in taken if (used[name] - asked[name]) * (_LIMITS[name].free - asked[name]) > 0.0]  # of that plan
    if _outcome(search, _free(beyond)):
        taken = beyond
    for name in reversed(taken):
        left = [n for n in taken if n != name]
        if _outcome(search, _free(left)):
            taken = left
    return tuple(taken)


def _relaxed(search: Search, asked: dict[str, float], names: Sequence[str]) -> dict[str, float] | None:
    """Values of some limits with which there is a plan, as near to what was asked as bisection finds them; None: no such values."""
    free = _free(names)
    outcome = _outcome(search, free)
    if outcome is None:
        return None
    used = _used(search.problem, outcome, search.vehicle)
    values, low, high = None, 0.0, 2.0  # shares of the way to what the plan takes; a plan under a limit may take another way
    for _ in range(_HALVINGS):
        share = 0.5 * (low + high)
        tried = {name: _outward(asked[name], asked[name] + share * (used[name] - asked[name]))
                 for name in free}
        if _outcome(search, tried):
            values, high = tried, share
        else:
            low = share
    return values


def _outward(asked: float, value: float) -> float:
    """A value with two digits of its difference from what was asked, rounded away from that."""
    if value == asked:
        return value
    unit = 10.0 ** (floor(log10(abs(value - asked))) - 1)
    return round((ceil if value > asked else floor)(value / unit) * unit, 9)


def _used(problem: PerchProblem, outcome: Outcome, vehicle: Vehicle) -> dict[str, float]:
    """What a plan takes of each limit, by the names of their settings."""
    rows = dict(zip(plan_checks.NAMES, outcome.results))
    last, T = outcome.coefficients[-1], outcome.durations[-1]
    v = (last.shape[1] - 1) * (last[:, -1] - last[:, -2]) / T - problem.target_velocity
    s3, mass, least, most = problem.surface.normal, vehicle.mass, vehicle.thrust_min, vehicle.thrust_max
    rotors = rows["rotor_thrust"]
    return {"thrust_max": mass * rows["thrust"][MAXIMUM], "thrust_min": mass * rows["thrust"][MINIMUM],
            "height_min": rows["height"][MINIMUM], "height_max": rows["height"][MAXIMUM], "body_rate_max": rows["body_rate"][MAXIMUM],
            "speed_max": rows["speed"][MAXIMUM], "duration_max": float(outcome.durations.sum()),
            "clearance_min": rows["clearance"][MINIMUM], "tangential_speed_max": float(np.linalg.norm(v - (v @ s3) * s3)),
            "rotor_margin": min(rotors[MINIMUM] - least, most - rotors[MAXIMUM]) / (most - least)}
