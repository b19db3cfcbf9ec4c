"""Speed and accuracy of VIO and UKF on rendered perches; part of `python3 scripts/bench.py perception`."""

from __future__ import annotations

import time

import cv2
import numpy as np
from harness import Figure, figure, measure
from perch_core.scenario import load_scenario
from perch_eval import estimation_flight as flights
from perch_eval.perch_motion import PerchMotion, read_imu
from perch_core.vehicle import load_vehicle
from perch_perception.ukf import Estimator, ImuSample, VioPose

SCENARIOS = (("surface_60", "60 deg, 1.7 m"), ("surface_90", "90 deg, 1.7 m"),
             ("surface_60_far", "60 deg, 3 m"), ("surface_90_far", "90 deg, 3 m"))
LATENCY = 0.040  # [s]


def figures(quick: bool) -> list[Figure]:
    """VIO per frame, UKF per step and update; RMSE through the perch, its cost in latency."""
    cv2.setNumThreads(1)
    out, costs = [], []
    for scenario, name in SCENARIOS:
        axes, contact, ratios = [], [], []
        for seed in range(1 if quick else 20):
            flight = flights.fly(load_scenario(scenario), seed)
            steps = flights.run_vio(flight)
            costs += [1e3 * s.cost for s in steps]
            late = flights.run_estimator(flight, steps, latency=LATENCY)
            prompt = flights.run_estimator(flight, steps, latency=0.0)
            axes.append(100 * _rmse(flight, late))
            contact.append(np.degrees(np.linalg.norm(late.errors[-1, 6:9])))
            ratios.append(_rmse(flight, late).mean() / _rmse(flight, prompt).mean())
        axes = np.array(axes)
        for axis, values in zip("xyz", axes.T):
            out.append(figure(f"estimation: RMSE {axis} through the perch, {name}", "cm", values, 3.0))
        out += [figure(f"estimation: worst axis of all runs, {name}", "cm", axes.ravel(), 8.5, "max <="),
                figure(f"estimation: attitude at contact, {name}", "deg", contact, 1.0),
                figure(f"estimation: RMSE with 40 ms delay over that without, {name}", "-", ratios, 1.2)]
    return [figure("vio: frame (CPU time)", "ms", costs, 10.0), figure("vio: frame p99 (CPU time)", "ms", costs, 20.0, "p99 <="),
            *_ukf(quick), *out, *_ideal(quick)]


def _ideal(quick: bool) -> list[Figure]:
    values = []
    for seed in range(1 if quick else 20):
        flight = flights.fly(load_scenario("surface_90_ideal"), seed)
        values.append(100 * _rmse(flight, flights.run_estimator(flight, flights.run_vio(flight))))
    return [figure("estimation: RMSE of each axis, ideal, 90 deg, 1.7 m", "cm", values, 1.5)]


def _rmse(flight: flights.Flight, track: flights.EstimatorTrack) -> np.ndarray:
    perching = track.times >= flight.perch_time
    return np.sqrt((track.errors[perching, :3] ** 2).mean(axis=0))


def _ukf(quick: bool) -> list[Figure]:
    """One IMU step, and one VIO update with the replay of 40 ms."""
    imu, motion = load_vehicle("snapdragon").imu, PerchMotion()
    truth = motion.sample(np.arange(0.0, motion.duration - 0.003, 0.002))
    readings = read_imu(truth, imu, np.random.default_rng(1))
    estimator, q, updates, steps = Estimator(), truth.q_WB, [], []
    for k in range(len(truth.times)):
        begin = time.perf_counter()
        estimator.add_imu(ImuSample(k * 2_000_000, tuple(readings.gyro[k].tolist()), tuple(readings.accel[k].tolist())))
        steps.append(1e6 * (time.perf_counter() - begin))
        if k > 150 and k % 17 == 0:
            pose = VioPose((k - 20) * 2_000_000, truth.p_WB[k - 20], q[k - 20], np.eye(6) * 1e-5)
            begin = time.perf_counter()
            estimator.add_vio(pose)
            updates.append(1e3 * (time.perf_counter() - begin))
    read = measure(lambda: estimator.estimate, 100 if quick else 2000)
    return [figure("ukf: IMU step", "us", steps[500:], 30.0), figure("ukf: update with 40 ms of replay", "ms", updates[3:], 3.0),
            figure("ukf: reading the estimate", "us", 1e6 * read)]
