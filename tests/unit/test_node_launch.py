"""Launch: which nodes start, with which parameters, and what is refused."""

from __future__ import annotations

import json

import pytest
import yaml
from perch_core import config
from perch_core.errors import ConfigError, PerchError
from perch_eval import nodes as nodes_module
from perch_eval.node_launch import (
    NODES, NodeLaunch, choose_nodes, node_launches, parse_overrides, read_parameters)
from perch_eval.nodes import ALL_NODES, node_programs, programs
from perch_sim.scenario import Scenario, load_scenario


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A configuration folder of the test's own."""
    monkeypatch.setattr(config, "config_dir", lambda: tmp_path)
    return tmp_path


def scenario(**changes) -> Scenario:
    return Scenario(name="test", nodes=("vehicle", "controller", "mission"), **changes)


def test_later_sources_of_a_parameter_count(folder):
    (folder / "controller.yaml").write_text("/**: {ros__parameters: {gains: {a: 1.0, b: 1.0, c: 1.0}, vehicle: file}}")
    flown = scenario(vehicle="rpg", parameters={"controller": {"gains.b": 2.0, "gains.c": 2.0}})
    launches = node_launches(flown, ["controller"], overrides={"controller": {"gains": {"c": 3.0}}})
    wanted = {"gains.a": 1.0, "gains.b": 2.0, "gains.c": 3.0, "vehicle": "rpg"}
    assert {name: launches[0].parameters.get(name) for name in wanted} == wanted


def test_the_vehicle_waits_for_the_nodes_that_are_started(folder):
    def participants(*nodes: str) -> list[str]:
        vehicle = node_launches(scenario(), ["vehicle", *nodes])[0]
        return vehicle.parameters["participants"]

    assert participants("estimator", "controller", "mission", "perching_planner", "description") == ["estimator", "controller", "mission"]
    assert participants() == [""]


def test_the_host_knows_of_the_simulator_and_the_component_does_not(folder):
    (folder / "vehicle.yaml").write_text("/**: {ros__parameters: {lockstep: true}}")
    nodes = ("vehicle", "controller", "perching_planner", "description", "viewer")
    for lockstep in (True, False):
        launches = {launch.name: launch for launch in node_launches(scenario(), nodes, lockstep=lockstep)}
        assert {name: launch.host["use_sim_time"] for name, launch in launches.items()} == {name: lockstep or name != "vehicle" for name in nodes}
        assert {name: launch.host.get("lockstep") for name, launch in launches.items()} == {
            "vehicle": lockstep, "controller": lockstep, "perching_planner": None, "description": None, "viewer": None}
        assert not {"lockstep", "use_sim_time"} & {key for launch in launches.values() for key in launch.parameters}
    launch = node_launches(scenario(), ["mission"], overrides={"mission": {"lockstep_hold": "perch", "lockstep": False}})[0]
    assert launch.host == {"lockstep": False, "lockstep_hold": "perch", "use_sim_time": True}
    written = yaml.safe_load(launch.write(folder).read_text())["/**"]["ros__parameters"]
    assert written["use_sim_time"] is True and written["mission.planner_latency"] == launch.parameters["mission.planner_latency"]


def test_time_begins_with_the_goal_in_lockstep(folder, monkeypatch):
    monkeypatch.setattr(nodes_module, "executable", lambda package, name: f"/{package}/{name}")
    programs(scenario(), folder=folder / "logs", hold_for_goal=True)
    parameters = yaml.safe_load((folder / "logs" / "mission.yaml").read_text())["/**"]["ros__parameters"]
    assert parameters["lockstep_hold"] == "perch"


def test_seed_scenario_and_mode_reach_the_vehicle(folder):
    vehicle = node_launches(scenario(), ["vehicle"], seed=7, scenario_source="/x/my.yaml", lockstep=False)[0].parameters
    assert (vehicle["seed"], vehicle["scenario"]) == (7, "/x/my.yaml")


@pytest.mark.parametrize("content", ["vehicle: {ros__parameters: {a: 1}}", "/**: {a: 1}", "- 1", "/**: 1"])
def test_a_parameter_file_of_another_form_is_refused(folder, content):
    (folder / "vehicle.yaml").write_text(content)
    with pytest.raises(ConfigError, match="vehicle.yaml"):
        read_parameters("vehicle")


@pytest.mark.parametrize("file", sorted(config.config_dir().glob("*.yaml")), ids=lambda file: file.stem)
def test_every_parameter_file_of_the_repository_is_of_a_node_and_can_be_read(file):
    assert file.stem in NODES and read_parameters(file.stem)


def test_chosen_nodes():
    assert choose_nodes(scenario()) == ("vehicle", "controller", "mission", "description")
    assert choose_nodes(scenario(), without=["mission", "description"], extra=["recorder"]) == ("vehicle", "controller", "recorder")
    assert choose_nodes(scenario(), only=["vio_model"]) == ("vio_model",)


@pytest.mark.parametrize("arguments, words", [
    ({"only": ["pilot"]}, "'pilot' is not one of vehicle"),
    ({"without": ["vio"]}, "'vio' is not started anyway; started: vehicle, controller, mission, description"),
    ({"without": ["vehicle", "controller", "mission", "description"]}, "no node is left"),
])
def test_impossible_choices_are_refused(arguments, words):
    with pytest.raises(PerchError, match=words):
        choose_nodes(scenario(), **arguments)


def test_overrides_are_yaml_and_name_their_node():
    assert parse_overrides(["controller.gains.a:=2"]) == {"controller": {"gains.a": 2}}
    assert parse_overrides(["a.x:=1", "b.y:=[1.0, 2.0]", "a.x:=false"]) == {"a": {"x": False}, "b": {"y": [1.0, 2.0]}}
    for text in ("controller.a=1", "a:=1", ".a:=1", "controller.a:=[1"):
        with pytest.raises(PerchError, match="-p "):
            parse_overrides([text])
    with pytest.raises(PerchError, match="'vio', which is not started"):
        node_launches(scenario(), ["vehicle"], overrides={"vio": {"a": 1}})


def test_parameter_files_hold_for_every_namespace(tmp_path):
    file = NodeLaunch("vehicle", {"a.b": 1e-5, "c": [1.0], "d": "90"}).write(tmp_path)
    assert yaml.safe_load(file.read_text()) == {"/**": {"ros__parameters": {"a.b": 1e-5, "c": [1.0], "d": "90"}}}


def test_one_program_per_node_or_one_for_all(tmp_path, monkeypatch):
    monkeypatch.setattr(nodes_module, "executable", lambda package, name: f"/{package}/{name}")
    launches = node_launches(load_scenario("surface_90"), ["vehicle", "controller"])
    single = node_programs(launches, tmp_path, namespace="/quad1")
    assert [(p.command[0], p.nodes) for p in single] == [
        ("/perch_sim/vehicle", ("/quad1/vehicle",)), ("/perch_control/controller", ("/quad1/controller",))]
    assert "__ns:=/quad1" in single[0].command
    together = node_programs(launches, tmp_path, composed=ALL_NODES)
    assert [(p.command[0], p.nodes) for p in together] == [("/perch_eval/composed", ("/vehicle", "/controller"))]


def test_some_nodes_share_a_process(tmp_path, monkeypatch):
    monkeypatch.setattr(nodes_module, "executable", lambda package, name: f"/{package}/{name}")
    launches = node_launches(load_scenario("surface_90"), ["vehicle", "vio", "controller"])
    found = node_programs(launches, tmp_path, composed=("controller", "vehicle", "recorder"))
    assert [(p.command[0], p.nodes) for p in found] == [
        ("/perch_eval/composed", ("/vehicle", "/controller")), ("/perch_perception/vio", ("/vio",))]
    assert [entry["name"] for entry in json.loads((tmp_path / "composed.json").read_text())] == ["vehicle", "controller"]
    with pytest.raises(PerchError, match="'pilot' is not one of"):
        node_programs(launches, tmp_path, composed=("pilot",))
