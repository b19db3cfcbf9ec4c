"""The vehicle's derived figures and the scenarios' geometry and refusals."""

import math

import numpy as np
import pytest

from oracles.rigid_body import accelerations
from perch_core import config
from perch_core.errors import ConfigError
from perch_core.extends import extended_mapping
from perch_core.vehicle import GRAVITY, Vehicle, load_vehicle
from perch_sim.scenario import Scenario, load_scenario


def test_snapdragon_has_the_papers_thrust_range():
    vehicle = load_vehicle("snapdragon")
    assert 4 * vehicle.thrust_max == pytest.approx(4.5, abs=0.01)   # tau_max of [M:V]
    assert 4 * vehicle.thrust_min == pytest.approx(0.51, abs=0.01)
    assert vehicle.mass == 0.25


def test_allocation_is_the_sum_of_forces_and_their_lever_arms():
    """[tests P:eq2]"""
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


@pytest.mark.parametrize("change, words", [
    ({"mass": 0.6}, "cannot lift 0.6 kg"), ({"rotor_yaw_sign": [1000, -1, 1, -1]}, "rotor_yaw_sign: 1000 is outside [-1, 1]"),
    ({"rotor_yaw_sign": [1, 0, 1, -1]}, "are not each 1 or -1"), ({"rotor_yaw_sign": [1, 1, 1, 1]}, "without moment"),
    ({"rotor_xy": [[0.1, 0.1]] * 4}, "without moment"), ({"rotor_xy": [[math.inf, 0.1]] * 4}, "rotor_xy: inf is outside [-5, 5] m"),
    ({"inertia": [9e18, 9e18, 9e18]}, "inertia: 9e+18 is outside (0, 10] kg m^2"), ({"inertia": [6e-4, 5e-4, 2e-3]}, "impossible for a rigid body"),
    ({"inertia": [6e-2, 6e-2, 6e-2]}, "can have"), ({"thrust_coefficient": 1e-3}, "is outside (0, 1000] N"), ({"speed_min": 1700.0}, "cannot descend"),
    ({"body_rate_max": 1e9}, "body_rate_max: 1e+09 is outside (0, 10000] rad/s"), ({"name": "../x"}, "'../x' is no name"),
    ({"cameras": {"a/b": {}}}, "'a/b' is no name"),
    ({"perch_offset": 0.3, "ground_offset": 0.1461}, "ground_offset: 0.1461 m: its plate or gripper would be in the ground, 0.3 m below"),
])
def test_a_vehicle_that_no_vehicle_can_be_is_refused(change, words):
    content = config.read_yaml(config.find("vehicles", "snapdragon"))
    with pytest.raises(ConfigError) as error:
        config.from_mapping(Vehicle, content | change, "x.yaml")
    assert words in str(error.value)


@pytest.mark.parametrize("change, words", [
    ({"centre": [641.0, 240.0]}, "cameras.down.centre: [641.0, 240.0] px is outside the image, [0, 640] x [0, 480] px"),
    ({"exposure": 0.02}, "cameras.down.exposure: 0.02 s is above exposure_max 0.0097 s"),
    ({"rate": 100.0, "exposure_max": 0.02}, "cameras.down.exposure_max: 0.02 s is outside [0, 0.01] s, the period of frames at 100 Hz"),
    ({"rate": 100.0, "readout": 0.02}, "cameras.down.readout: 0.02 s is outside [0, 0.01] s"),
])
def test_a_camera_that_no_camera_can_be_is_refused(change, words):
    content = config.read_yaml(config.find("vehicles", "snapdragon"))
    cameras = content["cameras"] | {"down": content["cameras"]["down"] | change}
    with pytest.raises(ConfigError) as error:
        config.from_mapping(Vehicle, content | {"cameras": cameras}, "x.yaml")
    assert words in str(error.value)


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
    ({"world": {"room": [1.0, 2.0, 3.0]}}, "is not on the floor of the room"),
    ({"target": {"inclination_deg": 180.0, "height": 0.5}}, "below the search hover"),
    ({"nodes": ["vehicle", "pilot"]}, "'pilot' is not one of"),
    ({"parameters": {"pilot": {}}}, "parameters.pilot"),
    ({"parameters": {"vehicle": {"vehicle": "rpg"}}}, "parameters.vehicle.vehicle: follows from the scenario"),
    ({"targett": {}}, "unknown key"),
    ({"mode": "powerline"}, "world.cables: has 0 entries, outside [1, 100]"),
    ({"world": {"cables": [{"start": [1.0, 0.0, 2.0], "end": [1.0, 0.0, 2.0]}]}}, "world.cables[0]: cable: both ends"),
    ({"world": {"cables": [{"start": [0.0, 0.0, 2.0], "end": [4.0, 0.0, 2.0], "sag": 1e3}]}}, "world.cables[0].sag: 1000 m is outside [0, 4] m"),
    ({"name": "../../x"}, "'../../x' is no name"), ({"vehicle": "../vehicles/rpg", "name": "a" * 101}, "is no name"),
    ({"start": {"position": [1e9, 0.0, 0.0]}}, "start.position: 1e+09 is outside [-10000, 10000] m"),
    ({"start": {"position": [50.0, 0.0, 0.0]}}, "start.position: (50, 0, 0) m is not on the floor of the room"),
    ({"start": {"position": [0.0, 0.0, -0.5]}}, "start.position: (0, 0, -0.5) m is not on the floor of the room"),
    ({"adhesion": {"normal_speed": [1.0, 0.2]}}, "adhesion.normal_speed: [1, 0.2] m/s is empty"),
    ({"inspection": {"watched": [math.nan, 0.0, 0.0]}}, "inspection.watched: nan is outside [-10000, 10000] m"),
])
def test_scenarios_that_cannot_be_flown_are_refused(change, words):
    with pytest.raises(ConfigError) as error:
        config.from_mapping(Scenario, {"name": "x"} | change, "x.yaml")
    assert words in str(error.value) and "x.yaml" in str(error.value)


def write(folder, **files):
    for name, content in files.items():
        (folder / f"{name}.yaml").write_text(content)


def test_a_scenario_takes_over_what_it_does_not_say_itself(tmp_path):
    write(tmp_path, mine="extends: line_80\nname: mine\nmission: {perch_pitch_deg: 60.0}\nworld: {cables: [{start: [4.0, -2.0, 4.0], end: [4.0, 2.0, 4.0]}]}\n"
                         "parameters: {powerline_planner: {deadline: 12.0}, estimator: {vio.position: 0.001}}\n",
          theirs="extends: mine.yaml\nname: theirs\nmission: {replan: false}\n")
    mine, base = load_scenario(tmp_path / "theirs.yaml"), load_scenario("line_80")
    assert (mine.name, mine.vehicle, mine.mode) == ("theirs", base.vehicle, "powerline")
    assert mine.mission.perch_pitch_deg == 60.0 and not mine.mission.replan and mine.mission.takeoff_height == base.mission.takeoff_height
    assert len(mine.world.cables) == 1 and mine.world.room == base.world.room  # lists are replaced, mappings merged
    assert mine.parameters["powerline_planner"] == {**base.parameters["powerline_planner"], "deadline": 12.0}
    assert mine.parameters["controller"] == base.parameters["controller"]
    assert "extends" not in extended_mapping("scenarios", tmp_path / "theirs.yaml")


@pytest.mark.parametrize("base, own", [("nmpc.horizon: 0.4", "nmpc: {horizon: 0.6}"), ("nmpc: {horizon: 0.4}", "nmpc.horizon: 0.6")])
def test_a_parameter_replaces_that_of_the_base_however_either_is_written(tmp_path, base, own):
    write(tmp_path, first=f"extends: surface_90\nname: first\nparameters: {{controller: {{{base}}}}}\n",
          second=f"extends: first.yaml\nname: second\nparameters: {{controller: {{{own}}}}}\n",
          third=f"extends: second.yaml\nname: third\nparameters: {{controller: {{{base.replace('0.4', '0.8')}}}}}\n")
    for name, value in (("first", 0.4), ("second", 0.6), ("third", 0.8)):
        assert config.nested(load_scenario(tmp_path / f"{name}.yaml").parameters["controller"]) == {"nmpc": {"horizon": value}}


@pytest.mark.parametrize("start, words", [
    ("a", "a.yaml extends {0}/b.yaml extends {0}/a.yaml: extends: the files extend each other in a circle"),
    ("lost", "lost.yaml extends {0}/gone.yaml: extends: scenarios: nowhere: unknown; there are: inspection, line_180"),
    ("missing", "missing.yaml: extends: {0}/none.yaml: no such file"),
    ("odd", "odd.yaml: extends: 3 is neither a name in config/scenarios nor a file"),
    ("listed", "listed.yaml extends {0}/list.yaml: [1] is not a mapping"),
])
def test_files_that_cannot_be_extended_are_refused_with_their_chain(tmp_path, start, words):
    write(tmp_path, a="extends: b.yaml\nname: a\n", b="extends: a.yaml\nname: b\n", lost="extends: gone.yaml\nname: lost\n",
          gone="extends: nowhere\n", missing="extends: none.yaml\nname: missing\n", odd="extends: 3\nname: odd\n",
          listed="extends: list.yaml\nname: listed\n", list="[1]\n")
    with pytest.raises(ConfigError) as error:
        load_scenario(tmp_path / f"{start}.yaml")
    assert words.format(tmp_path) in str(error.value)


def test_a_value_that_is_refused_is_not_blamed_on_a_file_that_does_not_have_it(tmp_path):
    write(tmp_path, base="name: base\ntarget: {distance: 9.0}\n", own="extends: base.yaml\nname: own\n")
    with pytest.raises(ConfigError) as error:
        load_scenario(tmp_path / "own.yaml")
    assert str(error.value) == f"{tmp_path}/own.yaml extends {tmp_path}/base.yaml: target.distance: 9 is outside [0.8, 3.5] m"


def test_files_that_a_scenario_names_are_found_beside_it_or_in_the_current_folder(tmp_path, monkeypatch):
    """As those of `extends`, also through a scenario in another folder that extends it."""
    flights, other, here = (tmp_path / name for name in ("my flights", "other", "here"))
    for folder in (flights, other, here):
        folder.mkdir()
    write(flights, quad="extends: snapdragon\nmass: 0.26\n", pad="pad_size: [0.5, 0.5]\ntags: [{id: 1, centre: [0, 0], size: 0.2}]\n",
          base="name: base\nvehicle: quad.yaml\ntarget: {board: pad.yaml}\n", far="name: far\nvehicle: far_away.yaml\n")
    write(other, own="extends: '../my flights/base.yaml'\nname: own\n", quad="extends: snapdragon\nmass: 0.27\n", third="vehicle: quad.yaml\nname: third\n")
    write(here, quad="extends: snapdragon\nmass: 0.28\n", far_away="extends: snapdragon\n")
    monkeypatch.chdir(here)
    for file in ("../my flights/base.yaml", tmp_path / "other" / "own.yaml"):
        scenario = load_scenario(file)
        assert (scenario.vehicle, scenario.target.board) == (str(flights / "quad.yaml"), str(flights / "pad.yaml"))
        assert load_vehicle(scenario.vehicle).mass == 0.26
    assert load_scenario("../other/third.yaml").vehicle == str(other / "quad.yaml")
    assert load_scenario(flights / "far.yaml").vehicle == str(here / "far_away.yaml")
    assert load_scenario("surface_90").vehicle == "snapdragon"
