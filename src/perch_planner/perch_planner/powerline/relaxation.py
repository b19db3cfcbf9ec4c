"""Planning of a perch; where the solver finds none, a search for the limit that prevents it, the vehicle's limits last."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from time import perf_counter
from typing import NamedTuple

from perch_core.errors import PlanningRefusal
from perch_core.vehicle import Vehicle
from perch_planner.powerline.plan import Manoeuvre
from perch_planner.powerline.request import PerchPose, PowerlineRequest
from perch_planner.powerline.search import NotConverged, Search, Task
from perch_planner.powerline.settings import PowerlineSettings

FIRST_GUESSES = 2  # of a perch, before the limits are tried one at a time, and then IPOPT
IPOPT_TIME_FACTOR = 7.0  # times of a first attempt that does not converge, which IPOPT's greatest number of iterations takes
SPEED_FACTOR = 2.0  # of the rotors, without the range of their thrust; thrust grows with the square


class Relaxation(NamedTuple):
    """A limit, and a problem without it.

    Attributes:
        label: its name in messages.
        constraint: constraint of a refusal where this limit is the cause.
        relaxed: maps request, settings and vehicle to those without the limit.
    """

    label: str
    constraint: str
    relaxed: Callable[[PowerlineRequest, PowerlineSettings, Vehicle], tuple[PowerlineRequest, PowerlineSettings, Vehicle]]


RELAXATIONS = (
    Relaxation("height limit", "height [P:eq14e]", lambda r, s, v: (r, replace(s, height_min=-1000.0), v)),
    Relaxation("limit of the duration", "duration [P:eq14c]", lambda r, s, v: (r, replace(s, duration=(s.duration[0], 30.0)), v)),
    Relaxation("other lines", "clearance [P:eq14j]", lambda r, s, v: (replace(r, lines=(r.target(),)), s, v)),
    Relaxation("thrust range of the rotors", "rotor thrust [P:eq14f]",
               lambda r, s, v: (r, s, replace(v, speed_min=0.0, speed_max=SPEED_FACTOR * v.speed_max))),
    Relaxation("body-rate limit", "body rate", lambda r, s, v: (r, s, replace(v, body_rate_max=1e3))),
)


def plan_perch(search: Search, request: PowerlineRequest, pose: PerchPose, end_time: float) -> Manoeuvre:
    """Plan a perch; where the first guesses fail, remove limits one at a time, then try IPOPT while there is time.

    Args:
        search: of the vehicle, within all limits.
        request: with its deadline.
        pose: where to perch.
        end_time: that deadline on the clock of `perf_counter` [s].

    Raises:
        PlanningRefusal: no perch was found; names the limit whose removal admits one, where that is known.
    """
    task = search.perch(request, pose)
    try:
        return search.solve_and_check(task, guesses=FIRST_GUESSES)
    except NotConverged as refusal:
        found, attempt_time = _relaxed(search, task, refusal, end_time), refusal.attempt_time
    if isinstance(found, Manoeuvre):
        return found
    remaining = end_time - perf_counter() - (IPOPT_TIME_FACTOR * attempt_time if found.constraint != task.name else 0.0)  # keep time to report it
    if remaining <= 0.0:
        raise found
    try:
        return search.solve_and_check(replace(task, request=replace(request, solver="ipopt", deadline=remaining)), first=FIRST_GUESSES)
    except NotConverged:
        raise found from None


def _relaxed(search: Search, task: Task, refusal: NotConverged, end_time: float) -> Manoeuvre | PlanningRefusal:
    """Return a refusal with the first limit whose removal soon yields a perch, or that perch where it keeps all limits."""
    explanation = f"no single limit was identified as the cause (tried: {', '.join(relaxation.label for relaxation in RELAXATIONS)})"
    for relaxation in RELAXATIONS:
        remaining = end_time - perf_counter()
        if remaining < refusal.attempt_time:
            explanation = "no time was left to search for the cause; allow more time"
            break
        trial = replace(task.request, solver="fatrop", deadline=remaining)
        request, settings, vehicle = relaxation.relaxed(trial, search.settings, search.vehicle)
        relaxed_search = replace(search, settings=settings, vehicle=vehicle)
        try:
            found = relaxed_search.solve_and_check(relaxed_search.perch(request, task.goal), "trial", guesses=1)
        except PlanningRefusal:
            continue
        bounds = search.bounds(task, found.times, found.states, found.rates)
        violated = {str(bound): bound.margin for bound in bounds if not bound.holds}
        if found.duration > task.duration[1]:
            violated[f"duration {found.duration:.2f} s, required at most {task.duration[1]:g} s"] = task.duration[1] - found.duration
        if not violated:
            return replace(found, bounds=bounds)
        first, margin = next(iter(violated.items()))
        return PlanningRefusal(refusal.code, relaxation.constraint, margin,
                               f"no perch was found that keeps the {relaxation.label}; without it there is one: {first}")
    return PlanningRefusal(refusal.code, refusal.constraint, refusal.margin, f"{refusal}; {explanation}")
