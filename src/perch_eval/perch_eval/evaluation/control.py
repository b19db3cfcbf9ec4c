"""Flights with faults, and comparison of the controllers on the same flights; each has a separate page of results."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from itertools import product
from typing import Any

import numpy as np

from perch_eval.control_flights.comparison import CONDITIONS, CONTROLLERS, LINE, LINE_TIME, MANEUVERS, fly
from perch_eval.control_flights.faults import END_STATES, FAULTS, fly_fault
from perch_eval.evaluation.document import table, write_page
from perch_eval.evaluation.kept import computed
from perch_eval.evaluation.sections import Effort, Section

MOMENTS = 20                         # of each fault
QUICK_SEEDS, FULL_SEEDS = 1, 5       # of the comparison
WORST = 0.05                         # RMSE of each axis of a perch [m]
CUT = 0.6                            # share of the RMSE that L1 takes away
LOADED = "wind 5 m/s, mass +20 %"
NO_WAY = "no way out"
ENDINGS = ("hovering", "landed", "perched", "crashed", "lost")


def fault_sections(effort: Effort) -> list[Section]:
    """Return the ends of flights with each fault at random times; write `faults_in_flight.md` and its JSON."""
    jobs = [(fault.name, seed) for fault in FAULTS for seed in range(1, MOMENTS + 1)]
    flown = computed(effort, "faults", jobs, _faulted, lambda r: r["end"] in END_STATES)
    out = Section("c_faults", "Faults in flight",
                  f"Each fault strikes at {MOMENTS} random moments (seeds 1 to {MOMENTS}) between the order to take off and the planned contact of a "
                  "perch on a wall (`surface_90`); plant, IMU, VIO model, UKF, supervisor and law in one loop. The end is judged by the truth. "
                  "Every flight: faults_in_flight.md.")
    rows = []
    for fault in FAULTS:
        own = [r for r in flown if r["fault"] == fault.name]
        ends, touched = Counter(r["end"] for r in own), sum(bool(r["touched"]) and r["end"] in END_STATES for r in own)
        safe = sum(ends[e] for e in END_STATES)
        without = sum(_no_way_out(r) for r in own)
        rows.append((f"{fault.name}: {fault.about}", *(ends[e] for e in ENDINGS), without, touched))
        out.claim(fault.name, f"{safe}/{len(own)}: " + ", ".join(f"{ends[e]} {e}" for e in ENDINGS if ends[e]) + f"; {without} {NO_WAY}" * bool(without),
                  "", safe + without == len(own) if own else None, "every flight ends hovering, landed or perched, or had no way out")
    text = ["# Faults in flight", "", out.about, "",
            "*crashed*: broken by an impact, or a rotor touched the floor; *lost*: none of the others after 25 s; *touched the wall*: rotors touched "
            f"it on the way, and nothing broke; *{NO_WAY}*: from the true state in which the fault left the vehicle, without any delay, rotors at their "
            "limits in any combination, changed to any other once, were tried on the plant, and all of them broke it.", "",
            *table(" | ".join(("fault", *ENDINGS, f"of these {NO_WAY}", "touched the wall")), rows), "",
            "## Flights without a good end", "", *([_told(r) for r in flown if r["end"] not in END_STATES] or ["None."])]
    write_page(effort, "faults_in_flight", text, {"flights": flown})
    out.data = {"flights": flown}
    return [out]


def comparison_sections(effort: Effort) -> list[Section]:
    """Return the comparison of all controllers on the same flights; write `comparison.md` and `comparison.json`."""
    seeds = range(1, 1 + (FULL_SEEDS if effort.full else QUICK_SEEDS))
    jobs = [(c, k, m, seed) for seed in seeds for m in MANEUVERS for k in CONDITIONS for c in CONTROLLERS]
    flown = computed(effort, "comparison", jobs, _compared, lambda r: r["outcome"] in ("held", "perched"))
    runs = {key: [r for r in flown if (r["controller"], r["condition"], r["maneuver"]) == key] for key in product(CONTROLLERS, CONDITIONS, MANEUVERS)}
    offset = ", ".join(f"{x:g}" for x in LINE)
    out = Section("c_comparison", "Controllers compared on the same flights",
                  f"{'Seed 1' if len(seeds) == 1 else f'Seeds 1 to {len(seeds)}'}; true position against the reference "
                  "(line: as commanded; perch: the plan), RMS per axis x, y, z; "
                  f"the state is estimated (VIO model, UKF). Line: ({offset}) m in {LINE_TIME:g} s and 0.5 s of hover. Perch: 90 deg, 1.7 m, to the contact. "
                  "Wind 5 m/s blows at 45 deg to the wall. With L1 the controller measures thrust / mass in hover and flies the perch with it. "
                  "Every flight: comparison.md.")
    text = ["# Controllers compared", "", out.about]
    for maneuver in MANEUVERS:
        text += ["", f"## {maneuver.capitalize()}", "", "RMSE x, y, z [cm]; outcome, per seed where they differ.", "",
                 *table("| " + " | ".join(CONTROLLERS), ((k, *(_cell(runs[c, k, maneuver]) for c in CONTROLLERS)) for k in CONDITIONS))]
    for c in CONTROLLERS:  # what is given up early has a small error: every flight must come to its good end
        own = runs[c, "nominal", "perch"]
        worst = float(_rms(own).max())
        out.claim(f"{c}: perch, nominal, worst axis", f"{100 * worst:.1f} cm", "5 to 10.8 cm",
                  worst <= WORST and all(r["outcome"] == "perched" for r in own), f"at most {100 * WORST:g} cm; all perched")
    for law in ("geometric", "nmpc"):
        plain, adaptive = (float(np.linalg.norm(_rms(runs[c, LOADED, "line"]))) for c in (law, f"{law} + L1"))
        whole = all(r["outcome"] == "held" for r in runs[f"{law} + L1", LOADED, "line"])
        out.claim(f"{law}: line, {LOADED}, with L1", f"{100 * plain:.1f} -> {100 * adaptive:.1f} cm, {100 * (1 - adaptive / plain):.0f} % less", "",
                  adaptive <= (1 - CUT) * plain and whole, f"at least {100 * CUT:g} % less; with L1 all held")
    for c in CONTROLLERS:
        own = [r for r in flown if r["controller"] == c and r["maneuver"] == "perch"]
        out.show(f"{c}: perches that hold, all conditions", f"{sum(r['outcome'] == 'perched' for r in own)}/{len(own)}")
    write_page(effort, "comparison", text, {"flights": flown})
    out.data = {"flights": flown}
    return [out]


def _no_way_out(r: dict[str, Any]) -> bool:
    return r["search"] is not None and r["search"]["survived"] == 0


def _told(r: dict[str, Any]) -> str:
    """Return the description of a flight without a safe end, as an item of a list."""
    height, gap, speed, tilt = r["before"]
    return (f"* **{r['fault']}**, seed {r['seed']}, {r['time']:.2f} s after the order to take off ({r['phase'].lower()}): {r['done']}. Then "
            f"{height:.2f} m high, {gap:.2f} m from the wall, {speed:.1f} m/s, tilt {tilt:.0f} deg. "
            f"End: {r['end']}; touched {', '.join(r['touched']) or 'nothing'}. {_searched(r)}{' / '.join(r['events'])}")


def _searched(r: dict[str, Any]) -> str:
    x = r["search"]
    if x is None:
        return ""
    if x["survived"]:
        return f" A way out is not excluded: of the first {x['tried']} sequences of rotor commands that were tried one broke nothing at first. "
    return (f" No way out: all {x['tried']} sequences of rotor commands that were tried broke it, the last {1000 * x['latest']:.0f} ms after the "
            f"fault; within that time rotors of this lag turn the vehicle by no more than {x['turn_deg']:.0f} deg. ")


def _rms(own: Sequence[dict[str, Any]]) -> np.ndarray:
    """Return the RMS per axis of the errors of flights whose manoeuvre began [m], shape (3,)."""
    return np.sqrt(np.nanmean(np.square(np.array([r["rmse"] for r in own], float)), axis=0))


def _cell(own: Sequence[dict[str, Any]]) -> str:
    rmse = 100 * _rms(own)
    outcomes = [r["outcome"] for r in own]
    return ", ".join(f"{x:.1f}" for x in rmse) + "; " + (outcomes[0] if len(set(outcomes)) == 1 else " / ".join(outcomes))


def _faulted(job: tuple[str, int]) -> dict[str, Any]:
    return asdict(fly_fault(next(fault for fault in FAULTS if fault.name == job[0]), job[1]))


def _compared(job: tuple[str, str, str, int]) -> dict[str, Any]:
    controller, condition, maneuver, seed = job
    rmse, outcome = fly(*job)
    return {"controller": controller, "condition": condition, "maneuver": maneuver, "seed": seed, "rmse": rmse.tolist(), "outcome": outcome}
