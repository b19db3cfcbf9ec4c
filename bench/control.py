"""Speed of the control laws and how they fly: step times, tracking of the perch, L1 under wind and mass, both laws compared,
inspection.

The flights run on the plant of the tests (`tests/closed_loop`), those of the inspection on `perch_sim`, without ROS.
"""

from __future__ import annotations

import sys
from pathlib import Path
from time import perf_counter

import numpy as np

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests"))

from closed_loop.loop import Loop, fly_to_contact, make_loop, perch  # noqa: E402
from closed_loop.plant import Disturbances  # noqa: E402
from harness import Figure, figure, measure  # noqa: E402

from perch_control.geometric import GeometricController  # noqa: E402
from perch_control.l1 import L1Augmentation, L1Settings  # noqa: E402
from perch_control.nmpc import LineWeights, NmpcController, NmpcSettings  # noqa: E402
from perch_control.reference import FlatReference  # noqa: E402
from perch_control.rotor_lag import RotorEstimate  # noqa: E402
from perch_control.settings import GeometricGains  # noqa: E402
from perch_core.scenario import load_scenario  # noqa: E402
from perch_core.trajectory import rest_to_rest  # noqa: E402
from perch_core.vehicle import load_vehicle  # noqa: E402
from perch_eval.inspection.flight import fly  # noqa: E402
from perch_eval.inspection.layout import random_layout  # noqa: E402

VEHICLE = load_vehicle("snapdragon")
DISTURBED = {
    "nominal": Disturbances(),
    "wind 5 m/s, mass +20 %": Disturbances(mass_factor=1.2, wind=(5.0, 0.0, 0.0)),
    "one rotor -15 %": Disturbances(rotor_factor=(0.85, 1.0, 1.0, 1.0)),
    "inertia +30 %": Disturbances(inertia_factor=1.3),
    "motor lag doubled": Disturbances(lag_factor=2.0),
}


def _geometric() -> GeometricController:
    return GeometricController(VEHICLE, GeometricGains())


def _nmpc(thrust_states: bool = False) -> NmpcController:
    return NmpcController(VEHICLE, NmpcSettings(thrust_states=thrust_states), _geometric())


def _timed(law) -> list[float]:
    """The law's own time per step in flight [s]; filled while it flies."""
    times: list[float] = []
    control = law.control

    def timed(*arguments):
        begin = perf_counter()
        out = control(*arguments)
        times.append(perf_counter() - begin)
        return out

    law.control = timed
    return times


def _move(law, disturbances: Disturbances, adaptive: bool) -> Loop:
    """A move of 2 m, 1 m, 0.5 m in 2 s, begun when the adaptation has settled."""
    loop = make_loop(law=law, disturbances=disturbances)
    if adaptive:
        loop.controller.compensator = L1Augmentation(VEHICLE, L1Settings())
    loop.begin_in_hover()
    loop.run(1.0)
    hover = loop.references[-1]
    loop.states.clear(), loop.references.clear()
    loop.follow(rest_to_rest(hover, hover + [2, 1, 0.5], 0, 0.5, 2.0))
    loop.run(2.4)
    return loop


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
        times = _timed(law)
        for _ in range(1 if quick else 4):
            fly_to_contact(perch("surface_90_1.7m"), law=law)
        for bar, comparison in bars:
            out.append(figure(f"nmpc step, {states} states, {comparison.split()[0]}", "ms", 1e3 * np.array(times), bar, comparison))
    return out


def _perches(quick: bool) -> list[Figure]:
    out = []
    for name, make in (("geometric", _geometric), ("nmpc", _nmpc)):
        law = make()
        arrival, _ = fly_to_contact(perch("surface_90_1.7m"), law=law)
        out.append(figure(f"perch at 90 deg, true state: worst axis RMSE, {name}", "m", [arrival.rmse.max()], 0.05, "max <="))
        held = [fly_to_contact(perch(plan), law=law, noise_seed=seed)[0].holds
                for plan in ("surface_90_1.7m", "surface_90_3m") for seed in range(2 if quick else 5)]
        out.append(figure(f"perches held with estimation errors, {name}", "-", [float(np.mean(held))]))
    return out


def _comparison(quick: bool) -> list[Figure]:
    out = []
    for name, make in (("geometric", _geometric), ("nmpc", _nmpc)):
        law = make()
        for case, disturbances in DISTURBED.items():
            if quick and case not in ("nominal", "wind 5 m/s, mass +20 %"):
                continue
            plain, adaptive = (float(np.linalg.norm(_move(law, disturbances, on).rmse)) for on in (False, True))
            out.append(figure(f"RMSE, {case}, {name}", "m", [plain]))
            out.append(figure(f"RMSE, {case}, {name}+l1", "m", [adaptive]))
            if case.startswith("wind"):
                out.append(figure(f"L1 cuts the RMSE by, {case}, {name}", "-", [1.0 - adaptive / plain], 0.6, "min >="))
    return out


def _inspection(quick: bool) -> list[Figure]:
    """[P:VI-A]: random layouts in which the reference collides twice, flown with estimated state and a map with errors."""
    vehicle = load_vehicle("rpg")
    law = NmpcController(vehicle, NmpcSettings(lines=LineWeights(perception=1500.0, visibility=200.0, collision=2000.0)),
                         GeometricController(vehicle, GeometricGains()))
    law.lines(tuple((x, 0.0, 1.5, 0.0, 1.0, 0.0, 4.0, 0.03) for x in (4.0, 5.0, 6.0)))
    times, loop = _timed(law), make_loop(vehicle=vehicle, law=law)
    loop.begin_in_hover()
    loop.run(2.0)
    flights = [fly(random_layout(load_scenario("inspection"), seed), seed) for seed in range(1, 3 if quick else 21)]
    gain = np.mean([f.reference.reprojection for f in flights]) / np.mean([f.flown.reprojection for f in flights])
    return [figure("nmpc step with three lines, 13 states", "ms", 1e3 * np.array(times)),
            figure("inspection: collisions of the reference", "-", [f.reference.collisions for f in flights], 2, "min >="),
            figure("inspection: collisions flown", "-", [f.collisions for f in flights], 0, "max <="),
            figure("inspection: flights that ended early", "-", [float(bool(f.message)) for f in flights], 0, "max <="),
            figure("inspection: mean reprojection error cut by", "times", [gain], 5.0, "min >=")]


def figures(quick: bool) -> list[Figure]:
    """All figures of the group."""
    return _speed(quick) + _perches(quick) + _comparison(quick) + _inspection(quick)
