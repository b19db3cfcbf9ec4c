"""What L1 makes up for in hover because thrust / mass is not the file's becomes the vehicle's thrust before a perch."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from closed_loop.loop import make_loop, perch
from closed_loop.plant import Disturbances
from perch_control.admission import AtEnd, TrajectoryRefused
from perch_control.l1 import L1Augmentation
from perch_control.modes import State
from perch_core.vehicle import load_vehicle
from perch_eval.control_flights import comparison
from perch_eval.control_flights.comparison import fly


def hovering(adaptive):
    loop = make_loop(disturbances=Disturbances(mass_factor=1.2))
    if adaptive:
        loop.controller.compensator = L1Augmentation(load_vehicle("snapdragon"))
    loop.begin_in_hover()
    loop.run(3.0)
    return loop


def test_a_heavier_vehicle_is_known_before_the_perch_and_nothing_jumps():
    loop = hovering(True)
    before, speed = loop.controller.compensator.disturbance[2], np.array(loop.controller.flight_state.rotors.command)
    assert before == pytest.approx(-0.2 * 9.81, abs=0.15)
    with pytest.raises(TrajectoryRefused, match="misses the contact"):  # of a plan for the file's mass
        loop.follow(perch("surface_90_1.7m").trajectory, AtEnd.CONTACT, id=2)
    assert abs(loop.controller.compensator.disturbance[2]) < 0.3, "what is left is no mass"
    # Seen from outside nothing has changed yet: the same thrust at the same rotor speeds.
    loop.run(0.002)
    np.testing.assert_allclose(loop.controller.flight_state.rotors.command, speed, rtol=0.01)
    assert loop.controller.vehicle.thrust_max == pytest.approx(load_vehicle("snapdragon").thrust_max / 1.2, rel=0.02)


def test_without_l1_nothing_is_made_of_it():
    loop = hovering(False)
    loop.follow(perch("surface_90_1.7m").trajectory, AtEnd.CONTACT, id=2)
    assert loop.controller.vehicle.thrust_max == load_vehicle("snapdragon").thrust_max


@pytest.mark.parametrize("law, seed", [("geometric + L1", 1), ("nmpc + L1", 2)])
def test_a_heavy_vehicle_perches_in_the_wind(law, seed):
    assert fly(law, "wind 5 m/s, mass +20 %", "perch", seed)[1] == "perched"


@pytest.mark.parametrize("end, outcome", [("perched",) * 2, ("held with running motors",) * 2, ("in flight", "missed: tilt"), ("crashed",) * 2])
def test_a_vehicle_that_is_held_has_not_missed(monkeypatch, end, outcome):
    monkeypatch.setattr(comparison, "simulated_ending", lambda *_: end)
    trace = SimpleNamespace(contacts=[SimpleNamespace(body="pad", reason="tilt")])
    flight = SimpleNamespace(simulation=None, state=State.RECOVERING, loop=SimpleNamespace(trace=trace))
    assert comparison._outcome(flight, "perch") == outcome
