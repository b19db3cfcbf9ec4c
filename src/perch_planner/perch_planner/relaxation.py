"""What stands in the way of a plan: the smallest set of limits whose relaxation gives one, and how little of it.

Each limit is taken away alone, and the plan that there is then says by how much it would have to give at most; bisection finds
how little is enough. Where no limit alone is enough, all are taken away, and put back one by one where there is a plan with them.
Every value that is named was tried: with it there is a plan.
"""

from __future__ import annotations

from dataclasses import replace
from math import ceil, floor, inf, log10
from typing import Any, NamedTuple

import numpy as np

from perch_planner import plan_checks, refusals
from perch_planner.certificates import certificates
from perch_planner.plan_checks import MAXIMUM, MINIMUM
from perch_planner.problem import Limits, PerchProblem, PerchSettings
from perch_planner.refusals import PerchRefusal
from perch_planner.search import Outcome, Search

_PROGRAMS = 40   # of each search with relaxed limits
_HALVINGS = 4    # of what a limit gives
_BEYOND = 10.0   # what the vehicle does not have counts so many times as far


class _Limit(NamedTuple):
    """A limit by the name of its setting.

    Attributes:
        free: value that takes it away.
        code: of a refusal because of it.
        words, unit: for the message.
        scale: a change of the setting that weighs as much as doubling or halving others; 0: its own value.
    """

    free: Any
    code: str
    words: str
    unit: str = ""
    scale: float = 0.0


_LIMITS = {
    "thrust_max": _Limit(1e3, refusals.THRUST_FLOOR, "thrust range [M:eq16]", "N"),
    "height_min": _Limit(-1e3, refusals.BOX, "height limits", "m", 1.0),
    "height_max": _Limit(1e3, refusals.BOX, "height limits", "m", 1.0),
    "body_rate_max": _Limit(1e3, refusals.BODY_RATE, "body-rate limit", "rad/s"),
    "speed_max": _Limit(1e3, refusals.BOX, "speed limit", "m/s"),
    "duration_max": _Limit(600.0, refusals.BOX, "duration_max", "s"),
    "clearance_min": _Limit(-1e3, refusals.BOX, "clearance from the surface until contact", "m", 0.1),
    "tangential_speed_max": _Limit(20.0, refusals.INFEASIBLE_WINDOW, "slip over the surface at contact [M:eq14]", "m/s", 1.0),
    "thrust_min": _Limit(1e-3, refusals.THRUST_FLOOR, "thrust range [M:eq16]", "N"),
    "rotors": _Limit("preferred", refusals.THRUST_FLOOR, "thrust range of the single rotors", scale=0.1),
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
    names = [name for name in _LIMITS if asked[name] != _LIMITS[name].free]
    ways = [way for name in names if (way := _relaxed(search, asked, (name,)))]
    if not ways and (way := _relaxed(search, asked, _smallest(search, names))):
        ways = [way]
    if not ways:
        return PerchRefusal(refusals.INFEASIBLE_WINDOW, "impact window and tube [M:eq14, M:eq15]", -inf,
                            f"no plan, even without the other limits ({tried}); widen the impact speeds or the tube", proofs,
                            search.iterations)
    most = 4.0 * vehicle.thrust_max
    ways.sort(key=lambda way: sum(_far(name, asked[name], value, most) for name, value in way.items()))
    first, *others = [" and ".join(_said(name, value, most) for name, value in way.items()) for way in ways]
    name, value = next(iter(ways[0].items()))
    kept = " and ".join(dict.fromkeys(_LIMITS[name].words for name in ways[0]))
    also = f"; so there is with {' or '.join(others)}" if others else ""
    margin = -abs(value - asked[name]) if isinstance(value, float) else -inf
    return PerchRefusal(_LIMITS[name].code, kept, margin, f"no plan keeps the {kept} ({tried}); with {first} there is one{also}", proofs,
                        search.iterations, ways[0])


def _asked(settings: PerchSettings, limits: Limits) -> dict[str, Any]:
    """The limits that hold, by the names of their settings."""
    return {name: getattr(settings, name) for name in _LIMITS} | {
        "thrust_min": limits.thrust[0], "thrust_max": limits.thrust[1], "body_rate_max": limits.body_rate}


def _said(name: str, value: Any, most: float) -> str:
    beyond = f" (the vehicle has {most:.3g} N)" if name == "thrust_max" and value > most else ""
    return f"{name} {value:g} {_LIMITS[name].unit}{beyond}" if isinstance(value, float) else f"{name}: {value}"


def _far(name: str, asked: Any, value: Any, most: float) -> float:
    """How much a relaxation asks of a limit, in multiples of its scale."""
    limit = _LIMITS[name]
    if not isinstance(value, float):
        return limit.scale
    return abs(value - asked) / (limit.scale or abs(asked)) * (_BEYOND if name == "thrust_max" and value > most else 1.0)


def _outcome(search: Search, changes: dict[str, Any]) -> Outcome | None:
    """The plan under changed settings, None where none is soon found."""
    settings = replace(search.settings, iterations_max=_PROGRAMS, minimum_time=False, **changes)
    limits = Limits.of(settings, search.vehicle)
    try:
        _, outcome = Search(search.problem, settings, search.vehicle,
                            limits if settings.rotors == "required" else limits.without("rotor_thrust")).run()
    except PerchRefusal:
        return None
    return outcome if outcome.proved else None


def _smallest(search: Search, names: list[str]) -> tuple[str, ...]:
    """Limits without which there is a plan, and none of which can stay; those that give first are put back last."""
    taken = list(names)
    for name in reversed(names):
        left = [n for n in taken if n != name]
        if _outcome(search, {n: _LIMITS[n].free for n in left}):
            taken = left
    return tuple(taken)


def _relaxed(search: Search, asked: dict[str, Any], names: tuple[str, ...]) -> dict[str, Any] | None:
    """Values of some limits with which there is a plan, as near to what was asked as bisection finds them."""
    free = {name: _LIMITS[name].free for name in names}
    outcome = _outcome(search, free)
    if outcome is None:
        return None
    used = _used(search.problem, outcome, search.vehicle.mass)
    values, low, high = free, 0.0, 2.0  # shares of the way to what the plan takes; a plan under a limit may take another way
    for _ in range(_HALVINGS):
        share = 0.5 * (low + high)
        tried = {name: _outward(asked[name], asked[name] + share * (used[name] - asked[name])) if name in used else value
                 for name, value in free.items()}
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


def _used(problem: PerchProblem, outcome: Outcome, mass: float) -> dict[str, float]:
    """What a plan takes of each limit, by the names of their settings."""
    rows = dict(zip(plan_checks.NAMES, outcome.results))
    last, T = outcome.coefficients[-1], outcome.durations[-1]
    v = (last.shape[1] - 1) * (last[:, -1] - last[:, -2]) / T - problem.target_velocity
    s3 = problem.surface.normal
    return {"thrust_max": mass * rows["thrust"][MAXIMUM], "thrust_min": mass * rows["thrust"][MINIMUM],
            "height_min": rows["height"][MINIMUM], "height_max": rows["height"][MAXIMUM], "body_rate_max": rows["body_rate"][MAXIMUM],
            "speed_max": rows["speed"][MAXIMUM], "duration_max": float(outcome.durations.sum()),
            "clearance_min": rows["clearance"][MINIMUM], "tangential_speed_max": float(np.linalg.norm(v - (v @ s3) * s3))}
