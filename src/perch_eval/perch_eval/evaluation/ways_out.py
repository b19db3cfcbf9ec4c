"""Ways out of planned perches: trajectories from each instant of a plan to a hover, and flights that are cancelled on the way."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, replace
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from perch_control.mission.settings import MissionSettings
from perch_control.mission.ways_out import DECISION
from perch_core.errors import PlanningRefusal
from perch_core.surface import PerchSurface
from perch_core.vehicle import load_vehicle
from perch_eval.control_flights.aborted import fly_cancelled
from perch_eval.evaluation.document import Effort, Section, table, write_page
from perch_eval.evaluation.kept import cached_figures
from perch_eval.in_process.parameters import NodeParameters
from perch_eval.statistics import Rate
from perch_planner.perching_planner import PerchingPlannerParameters
from perch_planner.planner import plan
from perch_planner.powerline import problem
from perch_planner.powerline.planner import PowerlinePlanner
from perch_planner.powerline.starts import random_start
from perch_planner.problem import PerchProblem, StartState
from perch_planner.way_out import plan_way_out
from perch_sim.scenario import load_scenario

RATE = 20.0                                               # instants per second of a plan [Hz]
INCLINATIONS = (60, 90, 120)                              # [deg]
LINES = ("line_20", "line_20_pa", "line_80", "line_80_pa", "line_180")
PLANS = 20                                                # of each
EDGES = (0.0, 0.05, 0.1, 0.15, 0.3, 0.5, 0.7, 1.0, math.inf)  # of time to contact [s]
CANCELLED_FLIGHTS = {"surface_60": 8, "surface_90": 12, "line_80": 8}  # flights that are cancelled, each at another time
MAX_TIME_TO_CONTACT = 1.4                                 # at which the first of them is cancelled [s]
NO_CONTACT_BEFORE = MissionSettings().contact_early       # nearer to the contact a surface may already be touched [s]
LAST_WAY_OUT = {"surface": NO_CONTACT_BEFORE, "line": MissionSettings.way_out_until}  # before the contact [s]
REQUIRED_SHARE = 0.99                                     # share of the instants before that with a way out
INTERVAL = re.compile(r"\[(\S+), (\S+)\]")  # that was found, in a refusal


class Instant(NamedTuple):
    """Instant of a plan: time to contact [s], and the reason why there is no way out from its state; empty: there is one."""

    time_to_contact: float
    refusal: str


def sections(effort: Effort) -> list[Section]:
    """Return the share of instants with a way out and the cancelled flights; write `way_out.md` and `way_out.json`."""
    out = Section("c_way_out", "Ways out of planned perches",
                  f"For each plan a way out is planned {RATE:g} times a second: a trajectory from its state at that time to a hover, with all limits "
                  f"proved (surfaces) or checked at 1 ms (powerlines). {PLANS} plans each by the planners as shipped: surfaces 1.2 to 3 m away, "
                  "powerlines from the paper's start and from random ones.")
    jobs = [(name, seed) for name in (*map(str, INCLINATIONS), *LINES) for seed in range(1, PLANS + 1)]
    made = cached_figures(effort, "ways_out", jobs, _plan_instants, lambda r: not r["refused"])
    reasons: list[str] = []
    rows: list[tuple[object, ...]] = []
    for name in (*map(str, INCLINATIONS), *LINES):
        plans = [r for r in made if r["name"] == name]
        instants = [Instant(*pair) for r in plans for pair in r["instants"]]
        spans = [[x for x in instants if low <= x.time_to_contact < high] for low, high in pairwise(EDGES)]
        title = f"{name} deg" if name.isdigit() else name
        rows.append((title, *(_share(span) if span else "" for span in spans), _share(instants)))
        reasons += [f"{title}: {x.refusal}" for x in instants if x.refusal]
        early = [x for x in instants if x.time_to_contact >= NO_CONTACT_BEFORE]
        planned = sum(not r["refused"] for r in plans)
        out.claim(f"{title}: a way out {NO_CONTACT_BEFORE:g} s before contact and earlier", f"{_share(early)}; {planned} of {len(plans)} planned", "",
                  planned == len(plans) and Rate.from_outcomes(not x.refusal for x in early).at_least(REQUIRED_SHARE),
                  f"at least {100 * REQUIRED_SHARE:g} %, all planned")
    cancelled = [(name, k + 1, round(MAX_TIME_TO_CONTACT * (1.0 - (k + 0.5) / n), 3)) for name, n in CANCELLED_FLIGHTS.items() for k in range(n)]
    flown = cached_figures(effort, "aborted", cancelled, _fly_cancelled, lambda r: r["end"] == "hovering" or _too_late(r))
    text = ["# Ways out", "", out.about, "", "Instants with a way out, by time to contact [s]:", "",
            *table(" | ".join(("plans", *(f"{low:g} to {high:g}" for low, high in pairwise(EDGES[:-1])), f"from {EDGES[-2]:g}", "all")), rows), "",
            "## Refused", ""]
    text += _counted(reasons) or ["None."]
    text += ["", "## Cancelled flights", "", "The goal is cancelled on the way (modelled cameras, seeds from 1). *by a way out*: the controller left the "
             f"plan by a planned way out; *too late*: cancelled within {_too_late_at('surface'):g} s of the contact with a surface or "
             f"{_too_late_at('line'):g} s of that with a wire, no way out was left, and the mission says so.", ""]
    rows = []
    for name, n in CANCELLED_FLIGHTS.items():
        own = [r for r in flown if r["scenario"] == name]
        hovering, late = [r for r in own if r["end"] == "hovering"], sum(map(_too_late, own))
        left = [r for r in own if r["planned"]]
        rows.append((name, n, len(hovering), sum(r["planned"] for r in hovering), late, n - len(hovering) - late,
                     f"{min((r['margin'] for r in left), default=math.nan):.2f}", f"{max((r['rate'] for r in left), default=math.nan):.1f}"))
        others = [f"seed {r['seed']}, {r['before']:.2f} s before contact: {r['end']}" for r in own if r["end"] != "hovering" and not _too_late(r)]
        out.claim(f"{name}: cancelled on the way", f"{len(hovering)} hovering, {late} too late and attached, of {n}", "",
                  len(hovering) + late == n, "; ".join(("all; too late: see [way_out.md](way_out.md)", *others)))
    text += table("scenario | n | hovering | of these by a way out | attached, too late | other | least thrust margin | largest body rate [rad/s]", rows)
    text += ["", *table("scenario | seed | cancelled before contact [s] | end | by a way out | goal ended after [s] | message of the mission", (
        (r["scenario"], r["seed"], f"{r['before']:.2f}", r["end"], "yes" if r["planned"] and r["end"] == "hovering" else "no", f"{r['settled']:.2f}",
         r["message"]) for r in flown))]
    write_page(effort, "way_out", text, {"plans": made, "flights": flown})
    out.data = {"plans": made, "flights": flown}
    return [out]


def _share(instants: Sequence[Instant]) -> str:
    """Return how many of the instants have a way out, as text."""
    return f"{sum(not x.refusal for x in instants)} of {len(instants)}"


def _counted(reasons: Iterable[str]) -> list[str]:
    """Return reasons with their counts as a list; reasons that differ in an interval only count as one, with the range of each end."""
    found: dict[tuple[str, ...], list[list[str]]] = {}
    for reason in reasons:
        before, *ends = INTERVAL.split(reason, maxsplit=1)  # both ends and the text after them, or nothing
        found.setdefault((before, *ends[2:]), []).append(ends[:2])
    return [f"* {len(ends)}x " + f"[{', '.join(map(_span, zip(*ends)))}]".join(text)
            for text, ends in sorted(found.items(), key=lambda item: -len(item[1]))]


def _span(numbers: Iterable[str]) -> str:
    """Return the range of some numbers as text; a number itself if there is no other."""
    ordered = sorted(set(numbers), key=float)
    return ordered[0] if len(ordered) == 1 else f"{ordered[0]} to {ordered[-1]}"


def _too_late_at(scenario: str) -> float:
    """Return the time to contact from which on no way out can begin in time after a decision [s]."""
    return LAST_WAY_OUT[scenario.partition("_")[0]] + DECISION


def _too_late(r: dict[str, Any]) -> bool:
    """Return whether a flight is attached, as the mission reports, because no way out could begin before the contact."""
    return r["end"] == "attached" and r["before"] < _too_late_at(r["scenario"]) and r["perched"]


def _fly_cancelled(job: tuple[str, int, float]) -> dict[str, Any]:
    return asdict(fly_cancelled(*job))


def _plan_instants(job: tuple[str, int]) -> dict[str, Any]:
    """Compute the instants of one plan, or the reason for which it was refused."""
    name, seed = job
    rng = np.random.default_rng(seed)
    try:
        found = _surface(int(name), rng) if name.isdigit() else _line(name, seed, rng)
        return {"name": name, "seed": seed, "refused": "", "instants": found}
    except PlanningRefusal as refusal:
        return {"name": name, "seed": seed, "refused": str(refusal), "instants": []}


def _surface(inclination: int, rng: np.random.Generator) -> list[Instant]:
    settings = NodeParameters(load_scenario("surface_90"), 1).node_config("perching_planner", PerchingPlannerParameters).settings
    vehicle = load_vehicle("snapdragon")
    place = np.array([rng.uniform(1.2, 3.0), rng.uniform(-0.5, 0.5), rng.uniform(1.2, 1.8)])
    request = PerchProblem(StartState(np.array([0.0, 0.0, 1.2])), PerchSurface.from_inclination(place, math.radians(inclination)))
    perch = plan(request, settings, vehicle).trajectory
    return _instants(perch.duration, lambda t: plan_way_out(replace(request, start=StartState.on(perch, t)), settings, vehicle))


def _line(name: str, seed: int, rng: np.random.Generator) -> list[Instant]:
    vehicle = load_vehicle("rpg")
    planner, setup = PowerlinePlanner(vehicle), problem.load(f"powerline_{name}")
    request = setup.request(vehicle) if seed == 1 else random_start(setup.request(vehicle), setup, vehicle, rng)
    perch = planner.plan(request).perch
    if perch is None:
        raise PlanningRefusal("solver", "perch", -1.0, "no perch")

    def way_out(t: float) -> None:
        state = perch.states[int(np.searchsorted(perch.times, t))]
        planner.plan(replace(request, start=state, recovery_only=True, hover=request.start[:3]))

    return _instants(perch.duration, way_out)


def _instants(duration: float, way_out: Callable[[float], object]) -> list[Instant]:
    """Return the instants of a plan; `way_out` is called with the time since its start [s] and raises where it is refused."""
    found = []
    for t in np.arange(0.0, duration, 1.0 / RATE).tolist():
        try:
            way_out(t)
            found.append(Instant(duration - t, ""))
        except PlanningRefusal as refusal:
            found.append(Instant(duration - t, str(refusal)))
    return found
