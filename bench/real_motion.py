"""VIO on images rendered along recorded flights of racing pilots; part of `python3 bench/recordings.py`.

The motion is UZH-FPV's ground truth; camera, calibration errors and IMU are the simulator's. Before take-off, where the truth
jitters by some millimetres while the drone stands, it is replaced by its mean. The floor is a metre below that place, as a camera
4 cm above the floor has no features to track during a pilot's take-off.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from perch_core.vehicle import GRAVITY
from open_loop import flight as open_loop
from perch_eval.campaign.progress import with_progress
from perch_eval.campaign.workers import in_processes
from open_loop.motion import Motion
from perch_perception.vio import FrameOutcome
from perch_sim.rendering import build_scene
from perch_sim.scenario import load_scenario
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation, RotationSpline

FLIGHTS = {"indoor_forward_5": 15.0, "indoor_forward_9": 13.0, "indoor_forward_10": 13.0}  # the first seconds of each
SEEDS = range(1, 6)
ABOVE = 1.0      # the floor, at the start [m]
TAKE_OFF = 0.7, 1.2  # between these the mean of the truth becomes the truth [s]
KNOTS = 5        # of the truth's samples, which come with 500 Hz, one is a knot
BESIDE = 3.0     # from the path to the walls [m]


class RealMotion:
    """A recorded motion that starts at rest, `ABOVE` the origin, level and heading along x.

    Attributes:
        duration: of the part that is used [s].
        low, high: corners of the box around it [m], shape (3,).
    """

    def __init__(self, file: Path, duration: float) -> None:
        self.duration = duration
        rows = np.loadtxt(file)[::KNOTS]
        rows = rows[rows[:, 0] <= rows[0, 0] + duration + 1.0]
        times, turned, points = rows[:, 0] - rows[0, 0], Rotation.from_quat(rows[:, 4:]), rows[:, 1:4]
        before = times < TAKE_OFF[0]
        stood, place = turned[before].mean(), points[before].mean(axis=0)
        x = np.clip((times - TAKE_OFF[0]) / (TAKE_OFF[1] - TAKE_OFF[0]), 0.0, 1.0)
        share = x**3 * (10.0 - 15.0 * x + 6.0 * x**2)
        heading = Rotation.from_euler("z", -stood.as_euler("ZYX")[0])
        points = heading.apply(share[:, None] * (points - place)) + (0.0, 0.0, ABOVE)
        turned = stood * Rotation.from_rotvec(share[:, None] * (stood.inv() * turned).as_rotvec())
        self._path = make_interp_spline(times, points, k=5)
        self._turn = RotationSpline(times, heading * turned * (heading * stood).inv())
        self.low, self.high = points.min(axis=0), points.max(axis=0)

    def sample(self, times: np.ndarray) -> Motion:
        """Return the states at times [s], shape (n,)."""
        R, a = self._turn(times).as_matrix(), self._path(times, 2)
        return Motion(times, self._path(times), self._path(times, 1), R, self._turn(times, 1), np.einsum("nji,nj->ni", R, a + (0.0, 0.0, GRAVITY)))


def evaluate_flights(folder: Path) -> dict[str, Any]:
    """Run all flights with all seeds; return final errors as shares of the path, mean position NEES over 3, lost frames."""
    jobs = [(folder / f"{name}_snapdragon_with_gt.txt", duration, seed) for (name, duration), seed in product(FLIGHTS.items(), SEEDS)]
    found = dict(with_progress(in_processes(fly, jobs), len(jobs), unit="flights"))
    rows = [[found[job] for job in jobs if job[0].name.startswith(f"{name}_")] for name in FLIGHTS]
    return {"flights": [{"flight": name, "path_m": own[0]["path_m"], "error_percent": [100.0 * one["error_m"] / one["path_m"] for one in own],
                         "nees": float(np.mean([one["nees"] for one in own])), "lost": sum(one["lost"] for one in own)}
                        for name, own in zip(FLIGHTS, rows)]}


def fly(job: tuple[Path, float, int]) -> dict[str, float]:
    """Run one flight with a seed's textures, calibration errors, noise; start position and heading are known to 1 mm, 1 mrad."""
    cv2.setNumThreads(1)
    file, duration, seed = job
    motion, scenario = RealMotion(file, duration), load_scenario("surface_90")
    size = motion.high - motion.low + 2.0 * BESIDE
    world = replace(scenario.world, room=(float(size[0]), float(size[1]), float(motion.high[2]) + BESIDE),
                    room_centre=tuple((0.5 * (motion.low + motion.high))[:2].tolist()))
    scene = replace(build_scene(replace(scenario, world=world), seed), target=None, board=None)
    flight = open_loop.sensor_data(motion, scene, scenario, seed)
    steps = open_loop.run_vio(flight, level_ground=False)
    posed = [(s.error[:3], s.result.estimate.pose_covariance[:3, :3]) for s in steps if s.error is not None and s.result.estimate is not None]
    return {"path_m": float(np.linalg.norm(np.diff(flight.truth.p_WB, axis=0), axis=1).sum()), "error_m": float(np.linalg.norm(posed[-1][0])),
            "nees": float(np.mean([e @ np.linalg.solve(P, e) for e, P in posed])) / 3.0,
            "lost": sum(s.result.outcome is FrameOutcome.LOST for s in steps)}
