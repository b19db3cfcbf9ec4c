"""Speed of the control laws and how they fly: step times, tracking of the perch, L1 under wind and mass, both laws compared,
inspection.

The flights run on the plant of the tests (`tests/closed_loop`), those of the inspection on `perch_sim`, without ROS; on all processors
at once, but for those that measure a speed. A step's time is the processor time of its thread: a busy machine stretches the clock,
which is given beside it. Deadlines in real time: `bench.py ros`.
"""

from __future__ import annotations

import multiprocessing
import os
import sys
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from time import perf_counter, thread_time

import numpy as np

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests"))

from closed_loop.loop import Arrival, fly_to_contact, make_loop, perch  # noqa: E402
from closed_loop.plant import Disturbances  # noqa: E402
from harness import Figure, figure, measure  # noqa: E402

from perch_control.geometric import GeometricController  # noqa: E402
from perch_control.l1 import L1Augmentation, L1Settings  # noqa: E402
from perch_control.nmpc import LineWeights, NmpcController, NmpcSettings  # noqa: E402
from perch_control.reference import FlatReference  # noqa: E402
from perch_control.rotor_lag import RotorEstimate  # noqa: E402
from perch_control.settings import GeometricGains  # noqa: E402
from perch_core.vehicle import load_vehicle  # noqa: E402
from perch_eval.inspection.flight import fly  # noqa: E402
from perch_eval.inspection.layout import random_layout  # noqa: E402
from perch_sim.scenario import load_scenario  # noqa: E402

VEHICLE = load_vehicle("snapdragon")
LOADED = "wind 5 m/s, mass +20 %"
DISTURBED = {
    "nominal": Disturbances(),
    LOADED: Disturbances(mass_factor=1.2, wind=(5.0, 0.0, 0.0)),
    "one rotor -15 %": Disturbances(rotor_factor=(0.85, 1.0, 1.0, 1.0)),
    "inertia +30 %": Disturbances(inertia_factor=1.3),
    "motor lag doubled": Disturbances(lag_factor=2.0),
}


def _geometric() -> GeometricController:
    return GeometricController(VEHICLE, GeometricGains())


def _nmpc(thrust_states: bool = False, lines: bool = False) -> NmpcController:
    if lines:
        vehicle, weights = load_vehicle("rpg"), LineWeights(perception=1500.0, visibility=200.0, collision=2000.0)
        return NmpcController(vehicle, NmpcSettings(lines=weights), GeometricController(vehicle, GeometricGains()))
    return NmpcController(VEHICLE, NmpcSettings(thrust_states=thrust_states), _geometric())


LAWS: dict[str, Callable] = {"geometric": _geometric, "nmpc": _nmpc}


def _timed(law) -> tuple[list[float], list[float]]:
    """The law's own time per step in flight, processor and clock [s]; filled while it flies."""
    used: list[float] = []
    passed: list[float] = []
    control = law.control

    def timed(*arguments):
        begin, clock = thread_time(), perf_counter()
        out = control(*arguments)
        used.append(thread_time() - begin)
        passed.append(perf_counter() - clock)
        return out

    law.control = timed
    return used, passed


def _move_rmse(job: tuple[str, str, bool]) -> float:
    """`Loop.move_rmse` [m] by law, case and with L1 or not."""
    name, case, adaptive = job
    loop = make_loop(law=LAWS[name](), disturbances=DISTURBED[case])
    if adaptive:
        loop.controller.compensator = L1Augmentation(VEHICLE, L1Settings())
    return loop.move_rmse()


def _speed(quick: bool) -> list[Figure]:
    law, rotors = _geometric(), RotorEstimate((1260.0,) * 4, (1260.0,) * 4)
    state = (0.1, 0.0, 1.1, 0.2, 0.0, 0.0, 0.05, 0.0, 0.0, 0.99875, 0.1, 0.2, 0.0)
    packed = FlatReference(perch("surface_90_1.7m").trajectory).setpoint(1.5).packed
    step = measure(lambda: law.step(state, packed, rotors), repetitions=2000 if quick else 20000)
    source = FlatReference(perch("surface_90_1.7m").trajectory)
    rehearsal = measure(lambda: law.prepare(source, True), repetitions=5 if quick else 50)
    out = [figure("geometric step", "us", 1e6 * step, bar=10.0), figure("rehearsal of a perch", "ms", 1e3 * rehearsal)]
    for states, bars in ((13, ((0.3, "median <="), (0.6, "p99 <="))), (17, ((1.5, "p99 <="),))):
        law = _nmpc(states == 17)
        used, passed = _timed(law)
        for _ in range(1 if quick else 2):
            fly_to_contact(perch("surface_90_1.7m"), law=law)
        for bar, comparison in bars:
            out.append(figure(f"nmpc step, {states} states, {comparison.split()[0]}", "ms", 1e3 * np.array(used), bar, comparison))
        out.append(figure(f"nmpc step, {states} states, by the clock", "ms", 1e3 * np.array(passed)))
    law = _nmpc(lines=True)
    law.lines(tuple((x, 0.0, 1.5, 0.0, 1.0, 0.0, 4.0, 0.03) for x in (4.0, 5.0, 6.0)))
    used, _ = _timed(law)
    loop = make_loop(vehicle=law.vehicle, law=law)
    loop.begin_in_hover()
    loop.run(2.0)
    return [*out, figure("nmpc step with three lines, 13 states", "ms", 1e3 * np.array(used))]


def _arrival(job: tuple[str, str, int | None]) -> Arrival:
    """A perch by law, plan and seed of the estimation errors, None: true state."""
    name, plan, seed = job
    return fly_to_contact(perch(plan), law=LAWS[name](), noise_seed=seed)[0]


def _perches(quick: bool) -> list[Figure]:
    seeds = range(2 if quick else 5)
    jobs = {name: [(name, "surface_90_1.7m", None)] + [(name, plan, seed) for plan in ("surface_90_1.7m", "surface_90_3m") for seed in seeds]
            for name in LAWS}
    arrivals = iter(_flown(_arrival, [job for own in jobs.values() for job in own]))
    out = []
    for name, own in jobs.items():
        exact, *others = [next(arrivals) for _ in own]
        out.append(figure(f"perch at 90 deg, true state: worst axis RMSE, {name}", "m", [exact.rmse.max()], 0.05, "max <="))
        out.append(figure(f"perches held with estimation errors, {name}", "-", [float(np.mean([a.holds for a in others]))]))
    return out


def _comparison(quick: bool) -> list[Figure]:
    cases = [case for case in DISTURBED if not quick or case in ("nominal", LOADED)]
    jobs = [(name, case, adaptive) for name in LAWS for case in cases for adaptive in (False, True)]
    rmse = dict(zip(jobs, _flown(_move_rmse, jobs), strict=True))
    out = []
    for name in LAWS:
        for case in cases:
            plain, adaptive = rmse[name, case, False], rmse[name, case, True]
            out.append(figure(f"RMSE, {case}, {name}", "m", [plain]))
            out.append(figure(f"RMSE, {case}, {name}+l1", "m", [adaptive]))
            if case == LOADED:
                out.append(figure(f"L1 cuts the RMSE by, {case}, {name}", "-", [1.0 - adaptive / plain], 0.6, "min >="))
    return out


def _inspected(seed: int) -> tuple[int, float, int, float, bool]:
    """Collisions and reprojection error [px] of the reference and of the flight, and whether it ended early."""
    flown = fly(random_layout(load_scenario("inspection"), seed), seed)
    return flown.reference.collisions, flown.reference.reprojection, flown.collisions, flown.flown.reprojection, bool(flown.message)


def _inspection(quick: bool) -> list[Figure]:
    """[P:VI-A]: random layouts in which the reference collides twice, flown with estimated state and a map with errors."""
    before, error_before, collisions, error, early = np.array(_flown(_inspected, list(range(1, 3 if quick else 21))), float).T
    return [figure("inspection: collisions of the reference", "-", before, 2, "min >="),
            figure("inspection: collisions flown", "-", collisions, 0, "max <="),
            figure("inspection: flights that ended early", "-", early, 0, "max <="),
            figure("inspection: mean reprojection error cut by", "times", [np.mean(error_before) / np.mean(error)], 5.0, "min >=")]


def _flown(fly_one: Callable, jobs: list) -> list:
    """Results of all jobs in their order, by as many processes as there are processors."""
    with ProcessPoolExecutor(os.cpu_count(), mp_context=multiprocessing.get_context("fork")) as pool:
        return list(pool.map(fly_one, jobs))


def figures(quick: bool) -> list[Figure]:
    """All figures of the group."""
    return _speed(quick) + _perches(quick) + _comparison(quick) + _inspection(quick)
