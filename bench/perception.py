"""Bars of perception: tags and lines, and speed and accuracy of VIO and UKF on rendered perches, one at a time on each core."""

from __future__ import annotations

import time
from typing import NamedTuple

import cv2
import numpy as np
import perception_lines
import perception_tags
from harness import Figure, figure, measure
from open_loop import flight as open_loop
from open_loop.motion import PerchMotion, read_imu
from perch_eval.campaign.progress import with_progress
from perch_eval.campaign.workers import in_processes
from perch_core.vehicle import load_vehicle
from perch_perception.ukf import Estimator, ImuSample, Inertial, VioPose
from perch_perception.ukf.odometry import vio_state
from perch_sim.scenario import load_scenario

SEEDS = "lines: scene 1, flights from 0; tags: 5; VIO: flights from 0, IMU 1"
SCENARIOS = (("surface_60", "60 deg, 1.7 m"), ("surface_90", "90 deg, 1.7 m"),
             ("surface_60_far", "60 deg, 3 m"), ("surface_90_far", "90 deg, 3 m"))
IDEAL = "surface_90_ideal"
LATENCY = 0.040  # [s]


def figures(quick: bool) -> list[Figure]:
    """The figures of all parts."""
    return [*perception_lines.figures(quick), *perception_tags.figures(quick), *_estimation(quick)]


def _estimation(quick: bool) -> list[Figure]:
    """Measure times of VIO frames, UKF steps and updates, and the RMSE through the perch with and without latency."""
    ukf = _ukf(quick)  # by the wall clock: before the flights, which use every core
    tasks = [(scenario, seed) for scenario in (*dict(SCENARIOS), IDEAL) for seed in range(1 if quick else 20)]
    flown: dict[str, list[_FlightErrors]] = {scenario: [] for scenario, _ in tasks}
    for (scenario, _), one in with_progress(in_processes(_fly, tasks), len(tasks), unit="perches"):
        flown[scenario].append(one)
    costs = [cost for one in sum(flown.values(), []) for cost in one.costs]
    out = [figure("vio: frame (CPU time)", "ms", costs, 8.0), figure("vio: frame p99 (CPU time)", "ms", costs, 16.0, "p99 <="), *ukf]
    for scenario, name in SCENARIOS:
        flights = flown[scenario]
        axes = np.array([one.rmse for one in flights])
        for axis, values in zip("xyz", axes.T):
            out.append(figure(f"estimation: RMSE {axis} through the perch, {name}", "cm", values, 3.0))
        out += [figure(f"estimation: worst axis of all runs, {name}", "cm", axes.ravel(), 8.5, "max <="),
                figure(f"estimation: attitude at contact, {name}", "deg", [one.attitude for one in flights], 1.0),
                figure(f"estimation: RMSE with 40 ms delay over that without, {name}", "-", [one.delay_costs for one in flights], 1.2)]
    return [*out, figure("estimation: RMSE of each axis, ideal, 90 deg, 1.7 m", "cm", [one.rmse for one in flown[IDEAL]], 1.5)]


class _FlightErrors(NamedTuple):
    costs: list[float]   # of each frame [ms]
    rmse: np.ndarray     # of each axis through the perch [cm]
    attitude: float      # error at contact [deg]
    delay_costs: float   # RMSE with LATENCY over that without


def _fly(task: tuple[str, int]) -> _FlightErrors:
    """Run VIO and UKF on one rendered perch."""
    cv2.setNumThreads(1)
    scenario = load_scenario(task[0])
    flight, begin = open_loop.fly(scenario, task[1]), open_loop.motion_of(scenario, task[1]).perch_time
    steps = open_loop.run_vio(flight)
    late = open_loop.run_estimator(flight, steps, latency=LATENCY)
    prompt = open_loop.run_estimator(flight, steps, latency=0.0)
    return _FlightErrors([1e3 * s.cost for s in steps], 100 * _rmse(late, begin), float(np.degrees(np.linalg.norm(late.errors[-1, 6:9]))),
                  float(_rmse(late, begin).mean() / _rmse(prompt, begin).mean()))


def _rmse(track: open_loop.EstimatorTrack, begin: float) -> np.ndarray:
    return np.sqrt((track.errors[track.times >= begin, :3] ** 2).mean(axis=0))


def _ukf(quick: bool) -> list[Figure]:
    """Time an IMU step, and a VIO update with 40 ms of replay: with VIO's whole state, as in flight, and with a pose only."""
    imu, motion = load_vehicle("snapdragon").imu, PerchMotion()
    truth = motion.sample(np.arange(0.0, motion.duration - 0.003, 0.002))
    readings = read_imu(truth, imu, np.random.default_rng(1))
    q, steps, updates = truth.q_WB, [], {"whole state": [], "pose": []}

    def state(k: int) -> VioPose:
        return vio_state(k * 2_000_000, truth.p_WB[k], q[k], truth.v_WB[k],
                         Inertial(readings.gyro_bias[k], readings.accel_bias[k], np.eye(15) * 1e-5))

    def pose(k: int) -> VioPose:
        return VioPose(k * 2_000_000, truth.p_WB[k], q[k], np.eye(6) * 1e-5)

    for took, measurement in zip(updates.values(), (state, pose)):
        estimator = Estimator()
        for k in range(len(truth.times)):
            begin = time.perf_counter()
            estimator.add_imu(ImuSample(k * 2_000_000, tuple(readings.gyro[k].tolist()), tuple(readings.accel[k].tolist())))
            steps.append(1e6 * (time.perf_counter() - begin))
            if k > 150 and k % 17 == 0:
                vio = measurement(k - 20)
                begin = time.perf_counter()
                estimator.add_vio(vio)
                took.append(1e3 * (time.perf_counter() - begin))
    read = measure(lambda: estimator.estimate, 100 if quick else 2000)
    return [figure("ukf: IMU step", "us", steps[500:], 30.0),
            *(figure(f"ukf: update with VIO's {kind}, 40 ms of replay", "ms", took[3:], 3.0) for kind, took in updates.items()),
            figure("ukf: reading the estimate", "us", 1e6 * read)]
