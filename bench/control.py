"""Speed of the control laws: times of their steps.

They fly on the plant of the tests (`tests/closed_loop`). The time of an NMPC's step is the processor time of its thread; wall-clock
time, which depends on other load, is given beside it, and alone for the geometric law, whose step is called again and again.
Real-time deadlines: `bench.py ros`. Flights: `evaluate.py --only c_comparison`.
"""

from __future__ import annotations

from time import perf_counter, thread_time

import numpy as np

from closed_loop.loop import fly_to_contact, make_loop, perch
from harness import Figure, figure, measure

from perch_control.geometric import GeometricController
from perch_control.nmpc import LineWeights, NmpcController, NmpcSettings
from perch_control.reference import FlatReference
from perch_control.rotor_lag import RotorEstimate
from perch_core.vehicle import Vehicle, load_vehicle

SEEDS = "none: nothing is random"
VEHICLE = load_vehicle("snapdragon")


def _geometric(vehicle: Vehicle = VEHICLE) -> GeometricController:
    return GeometricController(vehicle, vehicle.gains)


def _timed(law) -> tuple[list[float], list[float]]:
    """Return lists of the law's time per step, processor and wall clock [s], which are filled in flight."""
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


def figures(quick: bool) -> list[Figure]:
    """Times of a step, of the check of a contact, and of the NMPC in flight."""
    law, rotors = _geometric(), RotorEstimate((1260.0,) * 4, (1260.0,) * 4)
    state = (0.1, 0.0, 1.1, 0.2, 0.0, 0.0, 0.05, 0.0, 0.0, 0.99875, 0.1, 0.2, 0.0)
    source = FlatReference(perch("surface_90_1.7m").trajectory)
    packed = source.setpoint(1.5).packed
    step = measure(lambda: law.step(state, packed, rotors), repetitions=2000 if quick else 20000)
    check = measure(lambda: law.check_contact(source), repetitions=5 if quick else 50)
    out = [figure("geometric step", "us", 1e6 * step, bar=10.0), figure("check of a contact trajectory", "ms", 1e3 * check)]
    for states, bars in ((13, ((0.3, "median <="), (0.6, "p99 <="))), (17, ((1.5, "p99 <="),))):
        law = NmpcController(VEHICLE, NmpcSettings(), _geometric(), thrust_states=states == 17)
        used, passed = _timed(law)
        for _ in range(1 if quick else 2):
            fly_to_contact(perch("surface_90_1.7m"), law=law)
        for bar, comparison in bars:
            out.append(figure(f"nmpc step, {states} states, {comparison.split()[0]}", "ms", 1e3 * np.array(used), bar, comparison))
        out.append(figure(f"nmpc step, {states} states, by the clock", "ms", 1e3 * np.array(passed)))
    vehicle, weights = load_vehicle("rpg"), LineWeights(perception=1500.0, visibility=200.0, collision=2000.0)
    law = NmpcController(vehicle, NmpcSettings(lines=weights), _geometric(vehicle))
    law.lines(tuple((x, 0.0, 1.5, 0.0, 1.0, 0.0, 4.0, 0.03) for x in (4.0, 5.0, 6.0)))
    used, _ = _timed(law)
    loop = make_loop(vehicle=vehicle, law=law)
    loop.begin_in_hover()
    loop.run(2.0)
    return [*out, figure("nmpc step with three lines, 13 states", "ms", 1e3 * np.array(used))]
