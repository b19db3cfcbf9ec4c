"""Monte-Carlo runs of VIO, estimator and target on rendered perches: NEES and NIS with their bounds, as JSON and a picture.

Judged in the air: on the ground the vehicle stands exactly where it was told, and no covariance of use is as small as that.

    python -m perch_eval.consistency_runs --runs 50 --out out/consistency
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from perch_eval import consistency
from perch_eval import estimation_flight as flights
from perch_eval.arguments import command, command_parser, count, output_folder
from perch_eval.campaign.progress import counted
from perch_eval.campaign.workers import in_processes
from perch_eval.consistency import Consistency
from perch_eval.estimation_flight import EstimatorTrack
from perch_eval.evaluation.document import machine
from perch_eval.revision import made_of
from perch_eval.target_sightings import Sightings, see_target
from perch_sim.scenario import load_scenario

GROUPS = {"estimator: all 15 states": slice(0, 15), "estimator: position": slice(0, 3), "estimator: velocity": slice(3, 6),
          "estimator: attitude": slice(6, 9)}
AIRBORNE_AFTER = 0.4  # from the first thrust until the vehicle is clear of the ground [s]
LOOK = (-1.5, 0.4)    # the pad is looked at from the hover until it leaves the view, relative to the perch's begin [s]


@dataclass(frozen=True)
class _Run:
    """One flight: the estimator along it, VIO's NEES at its poses, the pad as it was seen."""

    track: EstimatorTrack
    vio_times: np.ndarray
    vio_nees: np.ndarray
    vio_nis: float  # over its dimension
    sightings: Sightings


def run(scenario_name: str, runs: int, first_seed: int = 100) -> tuple[list[Consistency], dict[str, object]]:
    """Fly, estimate and judge, one flight at a time on each core.

    Args:
        scenario_name: in config/scenarios.
        runs: Monte-Carlo runs.
        first_seed: seeds count up from here.

    Returns:
        NEES of estimator, VIO and target over time, and a summary with RMSE through the perch and mean NIS.
    """
    motion = flights.motion_of(load_scenario(scenario_name), first_seed)  # its phases are those of every run
    seeds = range(first_seed, first_seed + runs)
    flights_under_way = in_processes(_fly, [(scenario_name, seed) for seed in seeds])
    found = {seed: one for (_, seed), one in counted(flights_under_way, runs, what="perches")}
    flown = [found[seed] for seed in seeds]
    n = min(len(one.track.times) for one in flown)
    times = flown[0].track.times[:n]
    errors = np.array([one.track.errors[:n] for one in flown])
    covariances = np.array([one.track.covariances[:n] for one in flown])
    results = [consistency.judge(name, times, consistency.nees(errors[..., s], covariances[..., s, s]), s.stop - s.start)
               for name, s in GROUPS.items()]
    grid = np.arange(motion.settings.ground + AIRBORNE_AFTER, motion.duration - 0.1, 1 / 30)
    results.append(consistency.judge("vio: pose", grid, np.array([np.interp(grid, one.vio_times, one.vio_nees) for one in flown]), 6))
    results += _judge_target([one.sightings for one in flown])
    rmse = 100 * np.array([np.sqrt((one.track.errors[one.track.times >= motion.perch_time, :3] ** 2).mean(axis=0)) for one in flown])
    summary = {"scenario": scenario_name, "runs": runs, "rmse_cm_median": np.median(rmse, axis=0).tolist(),
               "rmse_cm_worst": rmse.max(axis=0).tolist(),
               "estimator_nis_over_6": float(np.concatenate([one.track.nis for one in flown]).mean() / 6),
               "vio_nis_over_dimension": float(np.mean([one.vio_nis for one in flown])),
               "nees": {r.name: {"inside": r.inside, "above": r.above, "mean_over_dimension": float(r.mean.mean() / r.dimension)}
                        for r in results}}
    return results, summary


def _fly(job: tuple[str, int]) -> _Run:
    """One flight of `run`."""
    cv2.setNumThreads(1)
    scenario, seed = load_scenario(job[0]), job[1]
    flight = flights.fly(scenario, seed)
    steps = flights.run_vio(flight)
    track = flights.run_estimator(flight, steps, begin=flight.motion.settings.ground + AIRBORNE_AFTER)
    posed = [s for s in steps if s.error is not None]
    seen = [s for s in posed if s.result.nis_dimension]
    nees = [consistency.nees(s.error[:6], s.result.estimate.pose_covariance) for s in posed if s.error is not None and s.result.estimate is not None]
    return _Run(track, np.array([s.time for s in posed]), np.array(nees),
                sum(s.result.nis for s in seen) / sum(s.result.nis_dimension for s in seen),
                see_target(scenario, flight, track, seed, flight.motion.perch_time + LOOK[0], flight.motion.perch_time + LOOK[1]))


def _judge_target(sightings: list[Sightings]) -> list[Consistency]:
    """NEES of the target's pose, at the images in which every run found the pad."""
    errors, covariances = np.array([s.errors for s in sightings]), np.array([s.covariances for s in sightings])
    seen = np.isfinite(errors).all(axis=(0, 2))
    groups = {"target: pose": slice(0, 6), "target: position": slice(0, 3), "target: attitude": slice(3, 6)}
    return [consistency.judge(name, sightings[0].times[seen], consistency.nees(errors[:, seen, s], covariances[:, seen, s, s]),
                              s.stop - s.start) for name, s in groups.items()]


def parser() -> argparse.ArgumentParser:
    """The command line."""
    out = command_parser("consistency_runs", __doc__, "")
    out.add_argument("--scenario", default="surface_90", help="perch that is flown (default: %(default)s)")
    out.add_argument("--runs", type=count, default=50, metavar="N", help="flights (default: %(default)s)")
    out.add_argument("--first-seed", type=count, default=100, metavar="N", help="first of consecutive seeds (default: %(default)s)")
    out.add_argument("--out", type=Path, default=Path("out/consistency"), metavar="DIR", help="folder of results (default: %(default)s)")
    return out


def _judge(arguments: argparse.Namespace) -> int:
    out, code = output_folder(arguments.out), {**made_of(), "machine": machine(), "first_seed": arguments.first_seed}
    results, summary = run(arguments.scenario, arguments.runs, arguments.first_seed)
    summary = code | summary
    (out / "consistency.json").write_text(json.dumps(summary, indent=2))
    consistency.plot(results, out / "consistency.png", {"take-off": 1.0, "hover": 3.0, "perch": 4.5})
    print(json.dumps(summary, indent=2))
    return 0


main = command(parser, _judge)

if __name__ == "__main__":
    sys.exit(main())
