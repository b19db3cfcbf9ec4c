"""Each rule of contact, by flying the plant into something."""

from __future__ import annotations

import dataclasses
from contextlib import nullcontext

import numpy as np
import pytest
from perch_core import so3
from perch_core.errors import ConfigError, PerchError
from perch_core.vehicle import GRAVITY, load_vehicle
from perch_sim.contact_event import ContactState
from perch_sim.plant import Plant
from perch_sim.scenario import Adhesion, Disturbance, Start, Target, load_scenario

SCENARIO = load_scenario("surface_90")
VEHICLE = load_vehicle(SCENARIO.vehicle)
OFF = np.zeros(4)


def plant_of(scenario=SCENARIO) -> Plant:
    return Plant(scenario, VEHICLE, seed=1, start=1_000_000_000)


def run(plant: Plant, seconds: float, target=OFF):
    """Contact events and IMU truth of a stretch."""
    outputs = [plant.advance(target) for _ in range(round(seconds / 0.002))]
    return [e for o in outputs for e in o.contacts], np.array([o.inertial for o in outputs])


def throw(plant: Plant, normal=0.5, tangential=0.0, tilt_deg=0.0, aside=0.0, gap=0.005, scenario=SCENARIO):
    """Put the vehicle `gap` in front of the pad, flying at it. `tilt` pitches, `aside` is along s2, `tangential` up."""
    pad = scenario.surface
    R_WB = pad.R_WS @ so3.exp(np.array([0.0, np.radians(tilt_deg), 0.0]))
    p_WB = pad.p_WS + VEHICLE.perch_offset * pad.normal + pad.R_WS @ np.array([0.0, aside, gap + 0.05 * abs(np.sin(np.radians(tilt_deg)))])
    v_WB = pad.R_WS @ np.array([tangential, 0.0, -normal])
    plant.place(p_WB, so3.quat_from_matrix(R_WB), v_WB, np.zeros(3), OFF)


def first(events):
    return next(e for e in events if e.state is not ContactState.NONE)


def test_resting_on_the_ground_is_quiet_and_reads_gravity():
    plant = plant_of()
    before = plant.state
    events, inertial = run(plant, 2.0)
    assert [e.state for e in events] == [ContactState.GROUND]
    np.testing.assert_allclose(plant.state.p_WB, before.p_WB, atol=1e-9)
    np.testing.assert_allclose(inertial - [0, 0, GRAVITY, 0, 0, 0], 0.0, atol=1e-6)


def test_take_off_and_landing_are_told():
    plant = plant_of()
    hover = np.sqrt(VEHICLE.hover_thrust / 4 / VEHICLE.thrust_coefficient)
    up, _ = run(plant, 0.6, np.full(4, 1.1 * hover))
    assert [e.state for e in up] == [ContactState.GROUND, ContactState.NONE]
    height = plant.state.p_WB[2]
    assert height > 0.1
    plant.place(np.array([0, 0, 0.1]), np.array([0, 0, 0, 1.0]), np.zeros(3), np.zeros(3), OFF)
    down, _ = run(plant, 1.0)
    assert down[0].state is ContactState.GROUND
    assert down[0].normal_speed == pytest.approx(np.sqrt(2 * GRAVITY * 0.06), rel=0.02)
    assert not plant.contact.crashed


@pytest.mark.parametrize("normal", [0.25, 0.5, 0.95])
def test_velcro_holds_within_its_limits(normal):
    plant = plant_of()
    throw(plant, normal=normal, tangential=0.3, tilt_deg=8.0, aside=0.1)
    events, inertial = run(plant, 1.5)
    event = first(events)
    assert event.state is ContactState.ATTACHED and event.body == "pad"
    assert event.normal_speed == pytest.approx(normal, abs=0.02)
    assert np.degrees(event.tilt_error) == pytest.approx(8.0, abs=0.5)
    assert event.offset == pytest.approx(0.1, abs=0.02)
    # a shock, then rest: hanging on the wall at the pad's attitude, the IMU reads gravity alone
    force = np.linalg.norm(inertial[:, :3], axis=1)
    assert force.max() > 2 * GRAVITY
    np.testing.assert_allclose(force[-100:], GRAVITY, rtol=1e-3)
    state = plant.state
    assert np.linalg.norm(state.v_WB) < 1e-4 and np.linalg.norm(state.w_WB_B) < 1e-3
    s3 = SCENARIO.surface.normal
    assert np.degrees(so3.angle_between(so3.quat_to_matrix(state.q_WB)[:, 2], s3)) < 2.0
    assert abs((state.p_WB - SCENARIO.surface.p_WS) @ s3 - VEHICLE.perch_offset) < 3e-3


@pytest.mark.parametrize("case, word", [
    (dict(normal=0.12), "normal speed"), (dict(normal=1.15), "normal speed"),
    (dict(tangential=0.8), "tangential speed"), (dict(tilt_deg=17.0), "tilt error"), (dict(aside=0.36), "outside the pad"),
])
def test_velcro_lets_go_outside_each_limit(case, word):
    plant = plant_of()
    throw(plant, **case)
    events, _ = run(plant, 0.1)
    event = first(events)
    assert event.state is ContactState.BOUNCED
    assert word in event.reason and event.reason.count(";") == 0
    assert not plant.contact.attached


def test_a_missed_pad_throws_the_vehicle_back():
    plant = plant_of()
    throw(plant, normal=1.3, gap=0.002)
    run(plant, 0.05)
    assert plant.state.v_WB @ SCENARIO.surface.normal > 0.1


def test_adhesion_can_be_switched_off():
    plant = plant_of(dataclasses.replace(SCENARIO, adhesion=Adhesion(enabled=False)))
    throw(plant)
    events, _ = run(plant, 0.1)
    assert first(events).state is ContactState.BOUNCED and "switched off" in first(events).reason


def test_rotors_first_is_a_collision():
    plant = plant_of()
    throw(plant, tilt_deg=45.0, gap=0.12)
    events, _ = run(plant, 0.4)
    assert first(events).state is ContactState.COLLISION
    assert "rotor" in first(events).reason


def test_walls_carry_no_velcro():
    wall = load_scenario("surface_90")
    plant = plant_of(wall)
    q_wall = so3.quat_from_matrix(wall.surface.R_WS)
    plant.place(np.array([5.9, 0.0, 2.0]), q_wall, np.array([0.6, 0, 0]), np.zeros(3), OFF)
    events, _ = run(plant, 0.3)
    assert first(events).state is ContactState.COLLISION and first(events).body == "wall"


def test_a_fall_is_a_crash_and_stops_the_rotors():
    plant = plant_of()
    plant.place(np.array([0, 0, 0.5]), np.array([0, 0, 0, 1.0]), np.zeros(3), np.zeros(3), OFF)
    events, _ = run(plant, 1.0)
    assert first(events).state is ContactState.COLLISION and "crashed" in first(events).reason
    assert plant.contact.crashed
    run(plant, 0.5, np.full(4, VEHICLE.speed_max))
    assert np.all(plant.rotor_speed < 1.0)


def test_the_point_that_touches_decides_on_a_crash_not_the_middle_of_the_plate():
    """A vehicle that tumbles slowly into the wall hits it with a fast rotor; one that flies the same way without the spin touches it softly."""
    for spin, crashed in ((30.0, True), (0.0, False)):
        plant = plant_of()
        throw(plant, normal=0.3, tilt_deg=45.0, gap=0.0)
        state = plant.state
        plant.place(state.p_WB, state.q_WB, state.v_WB, np.array([0.0, spin, 0.0]), OFF)
        events, _ = run(plant, 0.15)
        assert first(events).state is ContactState.COLLISION and plant.contact.crashed is crashed, (spin, first(events))
        assert not crashed or first(events).normal_speed < 2.0


def test_a_second_hard_impact_is_a_crash():
    plant = plant_of()
    throw(plant, normal=0.1, gap=0.001)  # too soft for the velcro
    events, _ = run(plant, 0.03)
    assert first(events).state is ContactState.BOUNCED and not plant.contact.crashed
    state = plant.state
    plant.place(state.p_WB, state.q_WB, -4.0 * SCENARIO.surface.normal, np.zeros(3), OFF)
    events, _ = run(plant, 0.03)
    assert plant.contact.crashed and "above 2 m/s" in events[0].reason


def test_tipping_over_on_the_floor_is_a_crash():
    plant = plant_of()
    plant.place(np.array([0, 0, 0.16]), so3.quat_exp(np.array([np.radians(80), 0, 0])), np.zeros(3), np.zeros(3), OFF)
    run(plant, 1.0)
    assert plant.contact.crashed
    assert plant.state.p_WB[2] > -0.01  # it lies on the floor, not in it


def test_a_moving_pad_carries_the_vehicle_away():
    moving = dataclasses.replace(SCENARIO, target=Target(velocity=(0.0, 0.3, 0.0)))
    plant = plant_of(moving)
    throw(plant)
    state = plant.state
    plant.place(state.p_WB, state.q_WB, state.v_WB + [0, 0.3, 0], np.zeros(3), OFF)
    events, _ = run(plant, 1.0)
    assert first(events).state is ContactState.ATTACHED
    assert first(events).tangential_speed < 0.12  # what gravity adds on the way
    assert plant.state.v_WB[1] == pytest.approx(0.3, abs=1e-3)
    np.testing.assert_allclose(plant.state.p_WB[1], 0.3, atol=0.01)


def energy(plant: Plant) -> float:
    x, body = plant.state.x, plant.body
    return 0.5 * body.mass * x[7:10] @ x[7:10] + 0.5 * x[10:13] @ (body.inertia * x[10:13]) + body.mass * GRAVITY * x[2]


@pytest.mark.parametrize("p, v, side", [((2.5, 0.0, 1.3), (-3.0, 0.0, 0.0), 1), ((0.9, 0.0, 1.3), (3.0, 0.0, 0.0), -1), ((1.75, 0.0, 2.2), (0.0, 0.0, 0.0), 0),
                                        ((1.78, 1.0, 1.5), (0.0, -1.0, 0.0), 0), ((1.75, 0.0, 0.3), (0.0, 0.0, 4.0), 0)],
                         ids=["behind", "front", "upper edge", "side edge", "lower edge"])
def test_a_panel_gives_no_energy_and_lets_nothing_through(p, v, side):
    plant, middle = plant_of(), SCENARIO.surface.p_WS[0] + 0.1
    plant.place(np.array(p), np.array([0.0, 0.0, 0.0, 1.0]), np.array(v), np.zeros(3), OFF)
    start, names = energy(plant), set()
    for _ in range(200):
        names |= {event.body for event in plant.advance(OFF).contacts}
        assert energy(plant) < 1.001 * start and side * (plant.state.p_WB[0] - middle) >= 0.0
    assert names & {"pad", "panel"}


@pytest.mark.parametrize("height, panel, refused", [(0.08, 5.0, True), (0.15, 5.0, True), (0.0, 5.0, False), (0.08, 1.2, False), (0.6, 5.0, False)])
def test_a_vehicle_does_not_start_within_the_panel(height, panel, refused):
    scenario = dataclasses.replace(SCENARIO, target=Target(inclination_deg=0.0, height=height, distance=1.0, panel_size=(panel, panel)))
    with pytest.raises(ConfigError, match="start.position: .* stand in the panel") if refused else nullcontext():
        plant_of(scenario)


@pytest.mark.parametrize("y, vehicle, words", [
    (2.45, VEHICLE, "start.position: .0, 2.45, 0. m: the vehicle would stand in the wall"),
    (2.35, VEHICLE, ""),
    (0.0, dataclasses.replace(VEHICLE, mass=5.0, inertia=(0.02, 0.02, 0.04), speed_max=9e3, perch_offset=0.02),
     "perch_offset: 0.02 m: the vehicle would stand on its rotors, as its weight presses the plate's felt by 0.025 m"),
    (0.0, dataclasses.replace(VEHICLE, ground_offset=0.12), "ground_offset: 0.12 m: the simulated vehicle stands on its plate, at 0.039 m"),
    (0.0, dataclasses.replace(VEHICLE, ground_offset=0.04), ""),
])
def test_a_vehicle_does_not_start_within_a_wall_nor_on_its_rotors(y, vehicle, words):
    scenario = dataclasses.replace(SCENARIO, start=Start(position=(0.0, y, 0.0)))
    with pytest.raises(ConfigError, match=words) if words else nullcontext():
        Plant(scenario, vehicle, seed=1, start=1_000_000_000)


def test_a_panel_smaller_than_its_pad_is_refused():
    with pytest.raises(ConfigError, match="target.panel_size: .* m is below the pad's .0.6, 0.6. m"):
        plant_of(dataclasses.replace(SCENARIO, target=Target(panel_size=(1.0, 0.5))))


def test_a_plate_is_held_at_rest_or_refused_but_never_shaken():
    """The longer the arm, the stiffer the hold for steps of 0.5 ms."""
    scenario = dataclasses.replace(SCENARIO, disturbance=Disturbance(inertia_factor=0.3))
    for offset in (0.04, 0.17):
        vehicle = dataclasses.replace(VEHICLE, perch_offset=offset)
        plant = Plant(scenario, vehicle, seed=1, start=1_000_000_000)
        pad = scenario.surface
        plant.place(pad.p_WS + (offset + 0.005) * pad.normal, so3.quat_from_matrix(pad.R_WS), -0.5 * pad.normal, np.zeros(3), OFF)
        run(plant, 1.5)
        assert plant.contact.attached and np.linalg.norm(plant.state.w_WB_B) < 0.5, offset
    with pytest.raises(ConfigError, match="vehicles/snapdragon.yaml: perch_offset: 0.3 m is too far for 0.25 kg"):
        Plant(scenario, dataclasses.replace(VEHICLE, perch_offset=0.3), seed=1, start=1_000_000_000)


def test_a_surface_effect_needs_propellers_of_a_size():
    scenario = dataclasses.replace(SCENARIO, disturbance=Disturbance(surface_effect=True))
    with pytest.raises(ConfigError, match="disturbance.surface_effect: needs the propeller_radius of snapdragon"):
        Plant(scenario, dataclasses.replace(VEHICLE, propeller_radius=0.0), seed=1, start=1_000_000_000)


@pytest.mark.parametrize("index", [7, 12])
def test_a_state_that_is_not_finite_ends_the_flight(index):
    plant = plant_of()
    plant.place(np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3), np.zeros(3), OFF)
    plant._x[index] = np.nan
    with pytest.raises(PerchError, match="not finite 0.00. s after the start"):
        run(plant, 0.01)


def test_adhesion_limits_are_those_of_the_material():
    limits = Adhesion()
    assert limits.normal_speed == (0.2, 1.0)
    assert limits.tangential_speed_max == 0.6 and limits.tilt_error_max_deg == 15.0
