"""What replanning in flight gains: the same seeds with and without it, from a campaign's results, as a picture and JSON.

    python3 scripts/campaign.py config/campaigns/replanning.yaml --engine in_process --out out/replanning
    python -m perch_eval.replanning out/replanning/results.sqlite --out docs/results
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import numpy as np
from perch_core.errors import PerchError
from perch_eval.campaign.causes import SUCCESS
from perch_eval.campaign.results import RunResult, read_results
from perch_eval.statistics import Rate, Spread

SWITCH = "mission.replan"
METRICS = {  # of a flight -> what it is, factor, unit
    "contact_offset_m": ("distance from the pad's middle at contact", 100.0, "cm"),
    "contact_normal_speed_m_s": ("speed into the pad", 1.0, "m/s"),
    "contact_tangential_speed_m_s": ("speed along the pad", 1.0, "m/s"),
    "contact_tilt_error_deg": ("tilt against the pad", 1.0, "deg"),
}


def pairs(results: list[RunResult]) -> list[tuple[RunResult, RunResult]]:
    """Flights that differ in replanning alone: (without, with).

    Raises:
        ValueError: the campaign did not vary `mission.replan`.
    """
    if any(SWITCH not in r.values for r in results):
        raise ValueError(f"{SWITCH} is not varied in these results")
    found: dict[str, dict[bool, RunResult]] = {}
    for r in results:
        rest = json.dumps([r.seed, sorted((k, v) for k, v in r.values.items() if k != SWITCH)])
        found.setdefault(rest, {})[bool(r.values[SWITCH])] = r
    return [(both[False], both[True]) for both in found.values() if len(both) == 2]


def summary(found: list[tuple[RunResult, RunResult]]) -> dict[str, object]:
    """Success and the contact's medians and largest values without and with replanning, and in how many pairs it came out lower."""
    out: dict[str, object] = {"pairs": len(found)}
    for name, k in (("without", 0), ("with", 1)):
        out[name] = {"perched": str(Rate(sum(pair[k].cause == SUCCESS for pair in found), len(found))),
                     **{m: _spread([pair[k].metrics.get(m) for pair in found]) for m in METRICS}}
    out["lower_with"] = {m: str(Rate(int(np.sum(b < a)), len(a))) for m, (a, b) in
                         ((m, _both(found, m)) for m in METRICS)}
    return out


def _both(found: list[tuple[RunResult, RunResult]], metric: str) -> tuple[np.ndarray, np.ndarray]:
    """The metric without and with, of pairs that both have it: those that both touched the pad."""
    values = np.array([[r.metrics.get(metric) for r in pair] for pair in found], float).reshape(-1, 2)
    return tuple(values[np.isfinite(values).all(axis=1)].T)


def _spread(values: list[float | None]) -> dict[str, float]:
    spread = Spread.of(values)
    return {"median": spread.median, "largest": spread.high}


def plot(found: list[tuple[RunResult, RunResult]], path: Path) -> None:
    """One panel per metric: without across, with up; below the diagonal replanning came out lower."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 2.9), layout="constrained")
    for axes, (metric, (words, factor, unit)) in zip(figure.subplots(1, len(METRICS)), METRICS.items()):
        without, with_ = (factor * v for v in _both(found, metric))
        top = 1.1 * max([*without, *with_, 1e-3])
        axes.plot([0, top], [0, top], color="0.7", lw=0.8)
        axes.plot(without, with_, "o", ms=3.5)
        axes.set(xlim=(0, top), ylim=(0, top), aspect="equal")
        axes.set_title(words, fontsize=8)
        axes.set_xlabel(f"without [{unit}]", fontsize=8)
        axes.set_ylabel(f"with replanning [{unit}]", fontsize=8)
    figure.savefig(path, dpi=130)


def main() -> int:
    """Command line; 2 where the results cannot be read."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", type=Path)
    parser.add_argument("--out", type=Path, default=Path("out/replanning"))
    arguments = parser.parse_args()
    try:
        found = pairs(read_results(arguments.results))
    except PerchError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    arguments.out.mkdir(parents=True, exist_ok=True)
    plot(found, arguments.out / "replanning.png")
    (arguments.out / "replanning.json").write_text(json.dumps(summary(found), indent=2) + "\n")
    print(json.dumps(summary(found), indent=2))
    return 0


if __name__ == "__main__":
    sys.exit(main())
