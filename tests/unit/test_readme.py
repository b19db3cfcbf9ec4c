"""What README and docs/interface.md show is true: commands are accepted, files exist, nodes have the topics, services and parameters named."""

from __future__ import annotations

import importlib
import os
import re
import shlex
import sys
from importlib.util import module_from_spec, spec_from_file_location
from itertools import chain
from pathlib import Path

import pytest
import rclpy
import yaml
from perch_core import config
from perch_core.ros.node import close_nodes
from perch_eval import demo
from perch_eval.domain import reserved_domain
from perch_eval.flyable import check_flight
from perch_sim.scenario import NODES
from perch_sim.scenario import load_scenario
from rclpy.action import get_action_server_names_and_types_by_node
from rclpy.qos import DurabilityPolicy

ROOT = Path(__file__).resolve().parents[2]
README = (ROOT / "README.md").read_text()
INTERFACE = (ROOT / "docs" / "interface.md").read_text()
BLOCKS = re.findall(r"```(\w*)\n(.*?)```", README, re.S)
COMMANDS = list(dict.fromkeys(
    [line.split("#")[0].strip() for kind, text in BLOCKS if not kind for line in text.splitlines() if line.startswith("python3 ")]
    + re.findall(r"`(python3 scripts/[^`]+)`", README + INTERFACE)))


def tables() -> dict[str, list[list[str]]]:
    """The rows of each table, without its head, by the word in its first column's head."""
    found: dict[str, list[list[str]]] = {}
    for text in re.findall(r"(?:^\|.*\n)+", f"{README}\n{INTERFACE}", re.M):
        head, _, *rows = [[cell.strip() for cell in line.strip("| \n").split("|")] for line in text.splitlines()]
        found[head[0]] = rows
    return found


def code(cell: str) -> list[str]:
    """The words of a cell that are set as code."""
    return re.findall(r"`([^`]+)`", cell)


TABLES = tables()


# -- commands --------------------------------------------------------------------------------------------------------

class Entered(Exception):
    """A script has accepted its arguments and enters its environment."""


def stop_at_the_door(*_: object, **__: object) -> None:
    """Stands in for `perch_setup.enter`."""
    raise Entered


@pytest.mark.parametrize("command", COMMANDS)
def test_commands_are_accepted(command, monkeypatch):
    _, path, *arguments = shlex.split(command)
    assert path.startswith("scripts/") and (ROOT / path).is_file()
    if path == "scripts/demo.py":
        demo.parser().parse_args(arguments)
        return
    spec = spec_from_file_location(f"readme_{Path(path).stem}", ROOT / path)
    script = module_from_spec(spec)
    spec.loader.exec_module(script)
    if hasattr(script, "command_line"):
        script.command_line().parse_args(arguments)
        return
    if not hasattr(script, "main"):  # it is that of a module
        (module,) = re.findall(r'run\("([\w.]+)"', (ROOT / path).read_text())
        assert callable(importlib.import_module(module).main)
        return
    monkeypatch.setattr(script, "enter", stop_at_the_door)
    monkeypatch.setattr(sys, "argv", [path, *arguments])
    with pytest.raises(Entered):
        script.main()


def test_what_the_commands_name_exists():
    named = {word: [] for word in ("demo.py", "start_stack.py", "plan.py", "bench.py", "run_node.py")}
    for command in COMMANDS:
        _, path, *arguments = shlex.split(command)
        named.setdefault(Path(path).name, []).append(arguments)
    for arguments in named["demo.py"] + named["start_stack.py"]:
        if "--scenario" in arguments:
            load_scenario(arguments[arguments.index("--scenario") + 1])
    for arguments in named["start_stack.py"]:
        if "--without" in arguments:
            assert arguments[arguments.index("--without") + 1] in NODES
    for arguments in named["plan.py"]:
        assert config.find("problems", arguments[0])
    for arguments in named["bench.py"]:
        assert (ROOT / "bench" / f"{arguments[0]}.py").is_file()
    for arguments in named["run_node.py"]:
        assert arguments[0] in NODES
    assert all(named[word] for word in ("demo.py", "start_stack.py", "plan.py", "bench.py"))
    for package, node in re.findall(r"ros2 run (\w+) (\w+)", README):
        assert NODES[node] == package


def test_the_scenario_of_the_example_can_be_flown(tmp_path):
    examples = [text for kind, text in BLOCKS if kind == "yaml"]
    assert examples
    for text in examples:
        file = tmp_path / "mine.yaml"
        file.write_text(text)
        check_flight(load_scenario(file), file)


def test_every_scenario_is_named():
    named = {name for row in TABLES["scenario"] for name in code(row[0])}
    assert named == {file.stem for file in (ROOT / "config" / "scenarios").glob("*.yaml")}


# -- the graph -------------------------------------------------------------------------------------------------------

@pytest.fixture(scope="module")
def nodes(tmp_path_factory):
    """Every node with the parameters of its file, by name, in this process."""
    folder = tmp_path_factory.mktemp("nodes")
    before = os.environ.get("ROS_DOMAIN_ID")
    created = {}
    with reserved_domain() as domain:
        os.environ["ROS_DOMAIN_ID"] = str(domain)
        rclpy.init(args=[])
        try:
            for node in (name for name in NODES if name != "vio_model"):  # the stand-in has the topics of vio
                arguments = ["--ros-args", "--params-file", str(ROOT / "config" / f"{node}.yaml")]
                if node == "recorder":
                    arguments += ["-p", f"file:={folder / 'flight.mcap'}"]
                if node == "viewer":
                    arguments += ["-p", "port:=0"]
                create = importlib.import_module(f"{NODES[node]}.{node}_node").create
                created[node] = create(cli_args=arguments, use_global_arguments=False)
                created[node].connect()
            yield created
        finally:
            close_nodes(list(created.values()))
            rclpy.try_shutdown()
            os.environ.pop("ROS_DOMAIN_ID")
            if before is not None:
                os.environ["ROS_DOMAIN_ID"] = before


def full_types(cell: str, kind: str) -> list[str]:
    """`package/kind/Name` of each type in a cell; a package counts until another is named."""
    package, types = "", []
    for word in re.sub(r"\([^)]*\)", "", cell).split(","):
        *named, name = word.strip().split("/")
        package = named[0] if named else package
        types.append(f"{package}/{kind}/{name}")
    return types


def class_name(msg_type: type) -> str:
    """`package/kind/Name` of a class of messages or services."""
    package, kind, *_ = msg_type.__module__.split(".")
    return f"{package}/{kind}/{msg_type.__name__}"


@pytest.mark.parametrize("row", TABLES["topic"], ids=lambda row: row[0].replace("`", ""))
def test_topics_have_publishers_types_and_durability_as_named(row, nodes):
    topics, profiles = code(row[0]), row[2].split(",")
    types = full_types(row[1], "msg")
    named = list(nodes) if row[5] == "all" else row[5].split(", ")
    for k, topic in enumerate(topics):
        wanted = types[k if len(types) > 1 else 0]
        of_node = {name: [p for p in nodes[name].publishers if p.topic_name == f"/{topic.lstrip('/')}"] for name in named}
        assert all(of_node.values()), f"{topic} is not published by {', '.join(name for name in named if not of_node[name])}"
        profile = profiles[k if len(profiles) > 1 else 0]
        latched = DurabilityPolicy.TRANSIENT_LOCAL if "TL" in profile else DurabilityPolicy.VOLATILE
        for publisher in chain.from_iterable(of_node.values()):
            assert class_name(publisher.msg_type) == wanted
            assert publisher.qos_profile.durability == latched, topic
            if re.search(r"\d", profile):
                assert publisher.qos_profile.depth == int(re.search(r"\d+", profile)[0]), topic


def test_every_published_topic_is_named(nodes):
    named = {f"/{topic.lstrip('/')}" for row in TABLES["topic"] for topic in code(row[0])}
    own = re.compile(r"^/(parameter_events|rosout|.*/_action/.*|.*/transition_event)$")  # ROS's
    published = {p.topic_name for node in nodes.values() for p in node.publishers}
    assert {topic for topic in published - named if not own.match(topic)} == set()


def test_services_and_action(nodes):
    for row in TABLES["name"]:
        node = nodes[row[2]]
        for k, name in enumerate(code(row[0])):
            package, kind, short = row[1].split(",")[k].strip().split("/")
            if kind == "action":
                assert (f"/{name}", [f"{package}/{kind}/{short}"]) in get_action_server_names_and_types_by_node(node, row[2], "/")
            else:
                assert (name, f"{package}/{kind}/{short}") in [(s.srv_name.strip("/"), class_name(s.srv_type)) for s in node.services]


def test_nodes_and_executables(nodes):
    assert [name for row in TABLES["node"] for name in code(row[0])] == list(nodes), "each once"
    for row in TABLES["node"]:
        package, executable = code(row[1])[0].split()
        assert NODES[executable] == package and code(row[0]) == [executable]
        assert (ROOT / "config" / f"{executable}.yaml").is_file()


def test_the_parameter_that_is_changed_exists(nodes):
    commands = [c for c in COMMANDS if "param.py set" in c]
    assert commands
    for command in commands:
        _, _, _, node, name, value = shlex.split(command)
        node = nodes[node.strip("/")]
        before, value = node.get_parameter(name).value, yaml.safe_load(value)
        # As it comes by service: arrays of numbers are no lists there.
        changed = rclpy.Parameter.from_parameter_msg(rclpy.Parameter(name, value=value).to_parameter_msg())
        result = node.set_parameters([changed])[0]
        assert result.successful, result.reason
        assert list(node.get_parameter(name).value) == value != list(before)
