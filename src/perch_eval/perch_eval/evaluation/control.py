"""Flights with faults, and comparison of the controllers on the same flights; each has a separate page of results."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from itertools import product
from typing import Any

import numpy as np

from perch_eval.control_flights.comparison import CONDITIONS, CONTROLLERS, LINE, LINE_TIME, MANEUVERS, fly
from perch_eval.control_flights.faults import END_STATES, FAULTS, fly_fault
from perch_eval.evaluation.document import Effort, Section, table, write_page
from perch_eval.evaluation.kept import cached_figures

GIVEN_PAD = "The pad is not localised: the planner is given its true pose, shifted by the position error of the estimate."
MOMENTS = 20                         # of each fault
QUICK_SEEDS, FULL_SEEDS = 1, 5       # of the comparison
MAX_RMSE = 0.05                      # of each axis of a perch [m]
REQUIRED_REDUCTION = 0.6             # share of the RMSE that L1 must remove
LOADED = "wind 5 m/s, mass +20 %"
NO_WAY_OUT = "no way out"
GOOD = ("held", "perched")
ENDINGS = ("hovering", "landed", "perched", "crashed", "lost")


def fault_sections(effort: Effort) -> list[Section]:
    """Return the ends of flights with each fault at random times; write `faults_in_flight.md` and its JSON."""
    jobs = [(fault.name, seed) for fault in FAULTS for seed in range(1, MOMENTS + 1)]
    flown = cached_figures(effort, "faults", jobs, _fly_with_fault, lambda r: r["end"] in END_STATES)
    about = (f"Each fault strikes at {MOMENTS} random moments (seeds 1 to {MOMENTS}) between the order to take off and the planned contact of a "
             f"perch on a wall (`surface_90`); plant, IMU, VIO model, UKF, supervisor and law in one loop. {GIVEN_PAD} The end is judged "
             "by the truth.")
    out = Section("c_faults", "Faults in flight", f"{about} Flights without a good end: [faults_in_flight.md](faults_in_flight.md).")
    rows = []
    for fault in FAULTS:
        own = [r for r in flown if r["fault"] == fault.name]
        ends, touched = Counter(r["end"] for r in own), sum(bool(r["touched"]) and r["end"] in END_STATES for r in own)
        safe = sum(ends[e] for e in END_STATES)
        without = sum(r["search"] is not None and r["search"]["survived"] == 0 for r in own)
        rows.append((f"{fault.name}: {fault.description}", *(ends[e] for e in ENDINGS), without, touched))
        found = f"{safe}/{len(own)}: " + ", ".join(f"{ends[e]} {e}" for e in ENDINGS if ends[e]) + f"; {without} {NO_WAY_OUT}" * bool(without)
        out.claim(fault.name, found, "", safe + without == len(own) if own else None, "every flight ends hovering, landed or perched, or had no way out")
    text = ["# Faults in flight", "", f"{about} Every flight: [faults_in_flight.json](faults_in_flight.json).", "",
            "*crashed*: broken by an impact, or a rotor touched the floor; *lost*: none of the others after 25 s; *touched the wall*: rotors touched "
            f"it on the way, and nothing broke; *{NO_WAY_OUT}*: from the true state in which the fault left the vehicle, without any delay, rotors at "
            "their limits in any combination, changed to any other once, were tried on the plant, and all of them broke it.", "",
            *table(" | ".join(("fault", *ENDINGS, f"of these {NO_WAY_OUT}", "touched the wall")), rows), "",
            "## Flights without a good end", "", *([_description(r) for r in flown if r["end"] not in END_STATES] or ["None."])]
    write_page(effort, "faults_in_flight", text, {"flights": flown})
    out.data = {"flights": flown}
    return [out]


def comparison_sections(effort: Effort) -> list[Section]:
    """Return the comparison of all controllers on the same flights; write `comparison.md` and `comparison.json`."""
    seeds = range(1, 1 + (FULL_SEEDS if effort.full else QUICK_SEEDS))
    jobs = [(c, k, m, seed) for seed in seeds for m in MANEUVERS for k in CONDITIONS for c in CONTROLLERS]
    flown = cached_figures(effort, "comparison", jobs, _fly_comparison, lambda r: r["outcome"] in GOOD)
    runs = {key: [r for r in flown if (r["controller"], r["condition"], r["maneuver"]) == key] for key in product(CONTROLLERS, CONDITIONS, MANEUVERS)}
    offset = ", ".join(f"{x:g}" for x in LINE)
    about = (f"{'Seed 1' if len(seeds) == 1 else f'Seeds 1 to {len(seeds)}'}; true position against the reference "
             "(line: as commanded; perch: the plan), RMS per axis x, y, z; "
             f"the state is estimated (VIO model, UKF). Line: ({offset}) m in {LINE_TIME:g} s and 0.5 s of hover. Perch: 90 deg, 1.7 m, to the contact. "
             "Wind 5 m/s blows at 45 deg to the wall. With L1 the controller measures thrust / mass in hover and flies the perch with it. "
             f"{GIVEN_PAD}")
    out = Section("c_comparison", "Controllers compared on the same flights", f"{about} All conditions: [comparison.md](comparison.md).")
    text = ["# Controllers compared", "", f"{about} Every flight: [comparison.json](comparison.json)."]
    for maneuver in MANEUVERS:
        text += ["", f"## {maneuver.capitalize()}", "", "RMSE x, y, z [cm]; outcomes.", "",
                 *table("| " + " | ".join(CONTROLLERS), ((k, *(_cell(runs[c, k, maneuver]) for c in CONTROLLERS)) for k in CONDITIONS))]
    failed = [f"* {m}, {k}, **{c}**: " + "; ".join(f"seed {r['seed']} {r['outcome']}" for r in bad) for m, k, c in product(MANEUVERS, CONDITIONS, CONTROLLERS)
              if (bad := [r for r in runs[c, k, m] if r["outcome"] not in GOOD])]
    text += ["", "## Flights without a good end", "", *(failed or ["None."])]
    for c in CONTROLLERS:  # what is given up early has a small error: every flight must come to its good end
        own = runs[c, "nominal", "perch"]
        worst = float(_rms(own).max())
        out.claim(f"{c}: perch, nominal, worst axis", f"{100 * worst:.1f} cm", "5 to 10.8 cm",
                  worst <= MAX_RMSE and all(r["outcome"] == "perched" for r in own), f"at most {100 * MAX_RMSE:g} cm; all perched")
    for law in ("geometric", "nmpc"):
        plain, adaptive = (float(np.linalg.norm(_rms(runs[c, LOADED, "line"]))) for c in (law, f"{law} + L1"))
        all_held = all(r["outcome"] == "held" for r in runs[f"{law} + L1", LOADED, "line"])
        out.claim(f"{law}: line, {LOADED}, with L1", f"{100 * plain:.1f} -> {100 * adaptive:.1f} cm, {100 * (1 - adaptive / plain):.0f} % less", "",
                  adaptive <= (1 - REQUIRED_REDUCTION) * plain and all_held, f"at least {100 * REQUIRED_REDUCTION:g} % less; with L1 all held")
    for c in CONTROLLERS:
        own = [r for r in flown if r["controller"] == c and r["maneuver"] == "perch"]
        out.show(f"{c}: perches that hold, all conditions", f"{sum(r['outcome'] == 'perched' for r in own)}/{len(own)}")
    write_page(effort, "comparison", text, {"flights": flown})
    out.data = {"flights": flown}
    return [out]


def _description(r: dict[str, Any]) -> str:
    """Return the description of a flight without a safe end, as an item of a list."""
    height, gap, speed, tilt = r["before"]
    return (f"* **{r['fault']}**, seed {r['seed']}, {r['time']:.2f} s after the order to take off ({r['phase'].lower()}): {r['done']}. Then "
            f"{height:.2f} m high, {gap:.2f} m from the wall, {speed:.1f} m/s, tilt {tilt:.0f} deg. "
            f"End: {r['end']}; touched {', '.join(r['touched']) or 'nothing'}. {_search_text(r)}Log: {' / '.join(r['events']) or 'empty'}.")


def _search_text(r: dict[str, Any]) -> str:
    x = r["search"]
    if x is None:
        return ""
    if x["survived"]:
        return f"A way out is not excluded: of the first {x['tried']} sequences of rotor commands that were tried one broke nothing at first. "
    return (f"No way out: all {x['tried']} sequences of rotor commands that were tried broke it, the last {1000 * x['latest']:.0f} ms after the "
            f"fault; within that time rotors of this lag turn the vehicle by no more than {x['turn_deg']:.0f} deg. ")


def _rms(own: Sequence[dict[str, Any]]) -> np.ndarray:
    """Return the RMS per axis of the errors of flights whose manoeuvre began [m], shape (3,)."""
    return np.sqrt(np.nanmean(np.square(np.array([r["rmse"] for r in own], float)), axis=0))


def _cell(own: Sequence[dict[str, Any]]) -> str:
    """Return the RMSE per axis [cm] and the number of flights with each outcome."""
    ends = Counter(re.split("[:,]", r["outcome"])[0] for r in own)
    return ", ".join(f"{x:.1f}" for x in 100 * _rms(own)) + "; " + (", ".join(f"{n} {end}" for end, n in ends.most_common()) if len(ends) > 1 else [*ends][0])


def _fly_with_fault(job: tuple[str, int]) -> dict[str, Any]:
    return asdict(fly_fault(next(fault for fault in FAULTS if fault.name == job[0]), job[1]))


def _fly_comparison(job: tuple[str, str, str, int]) -> dict[str, Any]:
    controller, condition, maneuver, seed = job
    rmse, outcome = fly(*job)
    return {"controller": controller, "condition": condition, "maneuver": maneuver, "seed": seed, "rmse": rmse.tolist(), "outcome": outcome}
