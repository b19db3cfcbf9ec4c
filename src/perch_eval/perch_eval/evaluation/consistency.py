"""Consistency of VIO, estimator and target over Monte-Carlo runs of rendered perches: NEES and NIS with their bounds.

Only samples in the air count: on the ground the position is known exactly, and no useful covariance is that small.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from perch_eval import consistency
from perch_eval import estimation_flight as flights
from perch_eval.campaign.progress import with_progress
from perch_eval.campaign.workers import in_processes
from perch_eval.consistency import Consistency
from perch_eval.estimation_flight import EstimatorTrack
from perch_eval.evaluation.document import Effort, Section
from perch_eval.target_sightings import Sightings, localize_target
from perch_sim.scenario import load_scenario

SCENARIO = "surface_90"
STATES = "estimator: all 15 states"
REQUIRED_SHARE = 0.85  # of the time inside the bounds
FULL = range(1, 201)  # seeds with --full: the more runs, the narrower the bounds that the requirement is about
GROUPS = {STATES: slice(0, 15), "estimator: position": slice(0, 3), "estimator: velocity": slice(3, 6),
          "estimator: attitude": slice(6, 9)}
TARGET_GROUPS = {"target: pose": slice(0, 6), "target: position": slice(0, 3), "target: attitude": slice(3, 6)}
AIRBORNE_AFTER = 0.4  # from the first thrust until the vehicle is clear of the ground [s]
SIGHTING_WINDOW = (-1.5, 0.4)  # of images of the pad: from the hover until it leaves the view, relative to the perch's begin [s]


@dataclass(frozen=True)
class _Run:
    """Result of one flight: track of the estimator, NEES of VIO at its poses, sightings of the pad."""

    track: EstimatorTrack
    vio_times: np.ndarray
    vio_nees: np.ndarray
    vio_nis: float  # over its dimension
    sightings: Sightings


def consistency_sections(effort: Effort) -> list[Section]:
    """Return NEES of estimator, VIO and target over time with its figure, RMSE during the perch, and mean NIS."""
    seeds = FULL if effort.full else effort.seeds
    out = Section("c_consistency", "Consistency of the estimators",
                  f"`{SCENARIO}` with cameras rendered and calibration errors drawn, seeds {seeds.start} to {seeds.stop - 1}; a motion "
                  "that differs between runs only by its sway in the hover, VIO's start parameters wrong as declared (1 mm, 1 mrad). NEES per "
                  "dimension, averaged over the flight; the "
                  "share of the time in which the mean over the runs is inside its 95 % bounds, and above them (overconfident).")
    motion = flights.motion_of(load_scenario(SCENARIO), seeds.start)  # its phases are those of every run
    found = dict(with_progress(in_processes(_fly, list(seeds), effort.jobs), len(seeds), unit="perches"))
    flown = [found[seed] for seed in seeds]
    n = min(len(one.track.times) for one in flown)
    results = _judged(GROUPS, flown[0].track.times[:n], [one.track.errors[:n] for one in flown], [one.track.covariances[:n] for one in flown])
    grid = np.arange(motion.settings.ground + AIRBORNE_AFTER, motion.duration - 0.1, 1 / 30)
    results.append(consistency.judge("vio: pose", grid, np.array([np.interp(grid, one.vio_times, one.vio_nees) for one in flown]), 6))
    seen = np.isfinite([one.sightings.errors for one in flown]).all(axis=(0, 2))  # images in which every run found the pad
    results += _judged(TARGET_GROUPS, flown[0].sightings.times[seen], [one.sightings.errors[seen] for one in flown],
                       [one.sightings.covariances[seen] for one in flown])
    for r in results:
        words = f"{r.mean.mean() / r.dimension:.2f}; {100 * r.inside:.0f} % inside, {100 * r.above:.0f} % above"
        if r.name == STATES:
            out.claim(r.name, words, "", r.inside >= REQUIRED_SHARE, f"inside for at least {100 * REQUIRED_SHARE:.0f} % of the time")
        else:
            out.show(r.name, words)
        out.data[r.name] = {"inside": r.inside, "above": r.above, "mean_over_dimension": float(r.mean.mean() / r.dimension), "bounds": r.bounds}
    rmse = 100 * np.array([np.sqrt((one.track.errors[one.track.times >= motion.perch_time, :3] ** 2).mean(axis=0)) for one in flown])
    out.show("RMSE of x, y, z through the perch", ", ".join(f"{x:.2f}" for x in np.median(rmse, axis=0)) + " cm", note="median")
    nis, dimension = np.concatenate([one.track.nis for one in flown]).sum(axis=0)
    out.show("NIS of the estimator over its dimension", f"{nis / dimension:.2f}")
    out.show("NIS of VIO over its dimension", f"{np.mean([one.vio_nis for one in flown]):.2f}")
    consistency.plot(results, effort.out / "consistency.png", {"take-off": 1.0, "hover": 3.0, "perch": 4.5})
    out.figures.append(("consistency.png", "NEES, mean over the runs, with its expectation and its 95 % bounds"))
    return [out]


def _fly(seed: int) -> _Run:
    """Fly one flight and run the estimators on it."""
    cv2.setNumThreads(1)
    scenario = load_scenario(SCENARIO)
    motion, flight = flights.motion_of(scenario, seed), flights.fly(scenario, seed)
    steps = flights.run_vio(flight)
    track = flights.run_estimator(flight, steps, begin=motion.settings.ground + AIRBORNE_AFTER)
    posed = [s for s in steps if s.error is not None]
    seen = [s for s in posed if s.result.nis_dimension]
    nees = [consistency.nees(s.error[:6], s.result.estimate.pose_covariance) for s in posed if s.error is not None and s.result.estimate is not None]
    return _Run(track, np.array([s.time for s in posed]), np.array(nees),
                sum(s.result.nis for s in seen) / sum(s.result.nis_dimension for s in seen),
                localize_target(scenario, flight, track, seed, motion.perch_time + SIGHTING_WINDOW[0], motion.perch_time + SIGHTING_WINDOW[1]))


def _judged(groups: dict[str, slice], times: np.ndarray, errors: list[np.ndarray], covariances: list[np.ndarray]) -> list[Consistency]:
    """Return the consistency of parts of a state; each run has errors (m, n) and covariances (m, n, n) at m times."""
    e, P = np.array(errors), np.array(covariances)
    return [consistency.judge(name, times, consistency.nees(e[..., s], P[..., s, s]), s.stop - s.start) for name, s in groups.items()]
