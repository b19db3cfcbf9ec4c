"""The gripper and the cables: each tolerance, the fall into the rotors, rest after the grip."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from perch_core import so3
from perch_core.catenary import Catenary
from perch_core.vehicle import GRAVITY, load_vehicle
from perch_sim.cable_contact import CableLine
from perch_sim.contact_event import ContactState
from perch_sim.plant import Plant
from perch_sim.scenario import Cable, Grip, Scenario, World

VEHICLE = load_vehicle("rpg")
CABLE = Cable(start=(3.0, -3.0, 3.0), end=(3.0, 3.0, 3.0))
SCENARIO = Scenario(name="one cable", mode="powerline", vehicle="rpg",
                    world=World(room=(14.0, 9.0, 8.0), room_centre=(3.0, 0.0), cables=(CABLE,)))
POINT, ALONG = np.array([3.0, 0.0, 3.0]), np.array([0.0, 1.0, 0.0])
OFF = np.zeros(4)


def approach(pitch_deg=80.0, off_square_deg=0.0, beside=0.0, speed=0.2, gap=0.004, scenario=SCENARIO):
    """Fly the gripper at the cable along -b3; `beside` passes it by. Returns plant, events and IMU truth of 0.6 s."""
    R_WB = so3.exp(np.array([0.0, -np.radians(pitch_deg), 0.0])) @ so3.exp(np.array([np.radians(off_square_deg), 0.0, 0.0]))
    b3 = R_WB[:, 2]
    p_WB = POINT + (VEHICLE.perch_offset + gap) * b3 + beside * R_WB[:, 0]
    plant = Plant(scenario, VEHICLE, 1, 0)
    plant.place(p_WB, so3.quat_from_matrix(R_WB), -speed * b3, np.zeros(3), OFF)
    outputs = [plant.advance(OFF) for _ in range(300)]
    return plant, [e for o in outputs for e in o.contacts], np.array([o.inertial for o in outputs])


@pytest.mark.parametrize("pitch_deg", [20.0, 80.0, 180.0])
def test_gripper_holds_at_any_pitch_and_hangs_at_rest(pitch_deg):
    plant, events, inertial = approach(pitch_deg)
    assert [(e.state, e.body) for e in events] == [(ContactState.ATTACHED, "cable 0")]
    state = plant.state
    gripper_W = state.p_WB - VEHICLE.perch_offset * so3.quat_to_matrix(state.q_WB)[:, 2]
    assert np.linalg.norm(gripper_W - POINT) < 0.01
    assert np.linalg.norm(state.v_WB) < 1e-3
    np.testing.assert_allclose(np.linalg.norm(inertial[-50:, :3], axis=1), GRAVITY, rtol=1e-2)


@pytest.mark.parametrize("case, word", [
    (dict(speed=0.5), "speed"), (dict(off_square_deg=13.0), "from square"), (dict(beside=-0.09), "passed at"),
])
def test_gripper_misses_outside_each_tolerance(case, word):
    plant, events, _ = approach(**case)
    assert events[0].state is ContactState.BOUNCED
    assert word in events[0].reason and ";" not in events[0].reason
    assert not plant.hold.active


def test_a_gripper_that_goes_no_deeper_grips_though_the_cable_comes_nearer_from_the_side():
    """At rest along b3, 3 cm off, and drifting with 0.1 m/s towards the middle of the claw."""
    R_WB = so3.exp(np.array([0.0, -np.radians(80.0), 0.0]))
    plant = Plant(SCENARIO, VEHICLE, 1, 0)
    plant.place(POINT + (VEHICLE.perch_offset + 0.02) * R_WB[:, 2] + 0.02 * R_WB[:, 0], so3.quat_from_matrix(R_WB),
                0.01 * R_WB[:, 2] - 0.1 * R_WB[:, 0], np.zeros(3), OFF)
    assert [e.state for e in plant.advance(OFF).contacts] == [ContactState.ATTACHED]


def test_a_pass_beyond_reach_is_no_contact():
    assert not [e for e in approach(pitch_deg=0.0, beside=0.5)[1] if e.body == "cable 0"]


def test_the_grip_can_be_switched_off():
    _, events, _ = approach(scenario=dataclasses.replace(SCENARIO, grip=Grip(enabled=False)))
    assert events[0].state is ContactState.BOUNCED and "switched off" in events[0].reason


def test_a_gripper_that_slows_down_in_reach_grips_then():
    """A vehicle that swings its gripper in too fast and comes to rest at the cable holds it."""
    R_WB = so3.exp(np.array([0.0, -np.radians(80.0), 0.0]))
    plant = Plant(SCENARIO, VEHICLE, 1, 0)
    plant.place(POINT + (VEHICLE.perch_offset + 0.004) * R_WB[:, 2], so3.quat_from_matrix(R_WB), np.zeros(3),
                np.array([0.0, -4.0, 0.0]), OFF)  # the gripper passes with 0.6 m/s
    events = []
    for _ in range(6):
        events += plant.advance(OFF).contacts
    assert not events and not plant.hold.active
    state = plant.state
    plant.place(state.p_WB, state.q_WB, np.zeros(3), np.zeros(3), OFF)
    for _ in range(20):
        events += plant.advance(OFF).contacts
    assert [e.state for e in events] == [ContactState.ATTACHED] and np.hypot(events[0].normal_speed, events[0].tangential_speed) < 0.4


def test_a_cable_in_the_rotors_is_a_crash():
    plant = Plant(SCENARIO, VEHICLE, 1, 0)
    plant.place(POINT + [0.0, 0.0, -0.4], np.array([0, 0, 0, 1.0]), np.array([0, 0, 3.5]), np.zeros(3), np.full(4, 1000.0))
    events = [e for _ in range(100) for e in plant.advance(np.full(4, 1000.0)).contacts]
    assert [e.state for e in events if e.body == "cable 0"] == [ContactState.COLLISION]  # it came from below, not at the gripper
    assert plant.crashed and np.all(plant.rotor_speed < 300.0)


def test_the_line_is_the_catenary():
    """Nearest points of a sagging cable, against dense samples of the exact curve."""
    cable = Cable(start=(0.0, -4.0, 3.0), end=(1.0, 4.0, 4.0), sag=0.4)
    line = CableLine(cable)
    dense = Catenary.from_sag(np.array(cable.start), np.array(cable.end), cable.sag).sample(20_001)
    for p in np.random.default_rng(1).uniform([-1, -4, 2], [2, 4, 5], (50, 3)):
        assert line.nearest(p).distance == pytest.approx(np.linalg.norm(dense - p, axis=1).min(), abs=1.5e-3)


@pytest.mark.parametrize("sag", [0.0, 0.5, 2.0, 4.0])
def test_the_line_is_within_a_millimetre_however_the_cable_sags(sag):
    cable = Cable(start=(4.0, -2.0, 5.0), end=(4.0, 2.0, 5.5), sag=sag)
    line = CableLine(cable)
    assert max(line.nearest(p).distance for p in cable.catenary().sample(700)) < 1e-3
