"""The vehicle's derived figures and the scenarios' geometry and refusals."""

import math

import numpy as np
import pytest
import yaml

from perch_core import config
from perch_core.errors import ConfigError
from perch_core.rigid_body import accelerations, attitude_rate
from perch_core.scenario import Scenario, load_scenario
from perch_core.vehicle import GRAVITY, Vehicle, load_vehicle


def test_snapdragon_has_the_papers_thrust_range():
    vehicle = load_vehicle("snapdragon")
    assert 4 * vehicle.thrust_max == pytest.approx(4.5, abs=0.01)   # tau_max of [M:V]
    assert 4 * vehicle.thrust_min == pytest.approx(0.51, abs=0.01)
    assert vehicle.mass == 0.25


def test_allocation_is_the_sum_of_forces_and_their_lever_arms():
    vehicle = load_vehicle("snapdragon")
    rng = np.random.default_rng(1)
    thrust = rng.uniform(0.1, 1.0, 4)
    arms = np.column_stack([vehicle.rotor_xy, np.zeros(4)])
    forces = np.column_stack([np.zeros((4, 2)), thrust])
    moment = np.cross(arms, forces).sum(axis=0)
    moment[2] += vehicle.torque_ratio * np.dot(vehicle.rotor_yaw_sign, thrust)
    assert np.allclose(vehicle.allocation @ thrust, [thrust.sum(), *moment])


def test_hover_is_an_equilibrium_and_spin_follows_euler():
    vehicle = load_vehicle("snapdragon")
    a, dw = accelerations(vehicle, np.eye(3), np.zeros(3), np.full(4, vehicle.hover_thrust / 4))
    assert np.allclose(a, 0, atol=1e-12) and np.allclose(dw, 0, atol=1e-9)
    w = np.array([1.0, -2.0, 3.0])
    _, dw = accelerations(vehicle, np.eye(3), w, np.zeros(4))
    J = vehicle.inertia_matrix
    assert w @ J @ dw == pytest.approx(0.0, abs=1e-12)           # free rotation keeps its energy
    assert (J @ w) @ (J @ dw) == pytest.approx(0.0, abs=1e-12)   # and the size of its momentum
    a, _ = accelerations(vehicle, np.eye(3), w, np.zeros(4))
    assert np.allclose(a, [0, 0, -GRAVITY])
    assert np.allclose(attitude_rate(np.eye(3), w) @ np.array([1.0, 0, 0]), np.cross(w, [1.0, 0, 0]))


def test_a_vehicle_that_cannot_lift_itself_is_refused(tmp_path):
    content = yaml.safe_load(config.find("vehicles", "snapdragon").read_text())
    content["mass"] = 0.6
    path = tmp_path / "heavy.yaml"
    path.write_text(yaml.safe_dump(content))
    with pytest.raises(ConfigError, match="cannot lift 0.6 kg"):
        config.load(Vehicle, path)


@pytest.mark.parametrize("name", sorted(p.stem for p in (config.config_dir() / "scenarios").glob("*.yaml")))
def test_every_scenario_loads_with_its_vehicle_and_board(name):
    scenario = load_scenario(name)
    assert scenario.name == name
    load_vehicle(scenario.vehicle)
    config.find("boards", scenario.target.board)


def test_surface_faces_the_start():
    for inclination in (0.0, 60.0, 90.0):
        for bearing in (-40.0, 0.0, 25.0):
            scenario = config.from_mapping(Scenario, {"name": "x", "target": {
                "inclination_deg": inclination, "bearing_deg": bearing}}, "x")
            surface = scenario.surface
            towards_start = np.array(scenario.start.position) + [0, 0, surface.p_WS[2]] - surface.p_WS
            s3 = surface.R_WS[:, 2]
            assert s3[2] == pytest.approx(math.cos(math.radians(inclination)), abs=1e-12)
            assert s3 @ towards_start == pytest.approx(
                math.sin(math.radians(inclination)) * np.linalg.norm(towards_start), abs=1e-9)


@pytest.mark.parametrize("change, words", [
    ({"target": {"distance": 0.0}}, "target.distance: 0 is outside [0.8, 3.5] m"),
    ({"target": {"distance": 3.4, "height": 3.5}}, "outside [0.8, 3.6] m that the camera reads"),
    ({"world": {"room": [1.0, 2.0, 3.0]}}, "outside the room"),
    ({"target": {"inclination_deg": 180.0, "height": 0.5}}, "below the search hover"),
    ({"nodes": ["vehicle", "pilot"]}, "'pilot' is not one of"),
    ({"parameters": {"pilot": {}}}, "parameters.pilot"),
    ({"targett": {}}, "unknown key"),
])
def test_scenarios_that_cannot_be_flown_are_refused(change, words):
    with pytest.raises(ConfigError) as error:
        config.from_mapping(Scenario, {"name": "x"} | change, "x.yaml")
    assert words in str(error.value) and "x.yaml" in str(error.value)
