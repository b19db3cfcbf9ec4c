"""What a user sees who gives wrong values: one clear line that names the value, its place and what is allowed; exit code 2."""

from __future__ import annotations

import importlib
import json
import math
import os
import signal
import subprocess
import sys
from pathlib import Path

import psutil
import pytest
import rclpy
from perch_core.errors import ConfigError
from perch_core.ros.node import close_nodes, connect
from perch_eval import demo
from perch_eval.ros.recorded_flight import RecordedFlight
from perch_eval.stack import Stack
from perch_sim.scenario import NODES
from perch_eval.nodes import ALL_NODES, executable
from perch_msgs.action import Perch
from perch_msgs.srv import PlanPerch
from rclpy.action import ActionClient
from rclpy.context import Context
from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from system import forks
from system.scripts import PATIENCE


BLIND = """
extends: surface_90
name: blind
nodes: [vehicle, vio_model, estimator, target_localizer, perching_planner, controller, mission]
parameters: {vehicle: {cameras: none}}
mission: {search_timeout: 100.0}
time_limit: 200.0
"""
"""A perch without images: it looks for a target until it is disturbed, however late that comes."""


# -- scenarios -------------------------------------------------------------------------------------------------------

SCENARIOS = {
    "unknown key": ("target: {distnce: 1.7}", "target.distnce: unknown key; allowed: inclination_deg, distance"),
    "wrong type": ("target: {distance: near}", "target.distance: 'near' is not of type float"),
    "unreachable target": ("target: {distance: 9.0}", "target.distance: 9 is outside [0.8, 3.5] m"),
    "not a number": ("target: {distance: .nan}", "target.distance: nan is outside [0.8, 3.5] m"),
    "infinite": ("start: {position: [.inf, 0.0, 0.0]}", "start.position: inf is outside [-10000, 10000] m"),
    "outside the room": ("target: {bearing_deg: 60.0, distance: 3.2}", "is outside the room"),
    "too far above": ("target: {height: 3.9, distance: 3.3}", "outside [0.8, 3.6] m that the camera reads"),
    "above the image": ("target: {height: 3.9, distance: 0.8}", "deg of the front camera's view"),
    "seen from behind": ("target: {height: 3.0, inclination_deg: 0.0}", "in which its tags can be read"),
    "unknown vehicle": ("vehicle: snapdragn", "vehicle: 'snapdragn': unknown; there are: betaflight, "),
    "unknown board": ("target: {board: no_pad}", "target.board: 'no_pad': unknown; there are: pad_four_tags"),
    "unknown node": ("nodes: [vehicle, pilot]", "nodes: 'pilot' is not one of vehicle"),
    "no mission": ("nodes: [vehicle, estimator, controller]", "nodes: 'mission' is missing; a flight needs it"),
    "parameters of no node": ("parameters: {pilot: {gain: 1.0}}", "parameters.pilot: is not one of vehicle"),
    "no YAML": ("target: [", "is not valid YAML"),
}


@pytest.mark.parametrize("content, words", SCENARIOS.values(), ids=SCENARIOS)
def test_scenarios_are_refused_before_anything_is_started(content, words, tmp_path, capsys):
    file = tmp_path / "mine.yaml"
    file.write_text(f"name: mine\n{content}\n")
    assert demo.main(["--scenario", str(file), "--out", str(tmp_path / "out")]) == 2
    out, error = capsys.readouterr()
    assert out == "" and len(error.splitlines()) == 1
    assert error.startswith(f"error: {file}: ") and words in error
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("arguments, words", [
    (["--scenario", "surface_91"], "scenarios: surface_91: unknown; there are: "),
    (["--scenario", "nowhere.yaml"], "nowhere.yaml: no such file"),
    (["--vehicle", "snapdragn"], "error: vehicles: snapdragn: unknown; there are: "),
    (["--seed", "-1"], "--seed: -1: is outside [0, 2147483647]"),
    (["--out", "/proc/flight"], "--out: /proc/flight: cannot be written"),
])
def test_arguments_of_the_demo(arguments, words, capsys):
    assert demo.main(arguments) == 2
    error = capsys.readouterr().err
    assert words in error and len(error.splitlines()) == 1


def test_a_parameter_that_a_node_refuses_is_invalid_input(tmp_path, monkeypatch, capfd):
    forks.fork_programs(monkeypatch)
    file = tmp_path / "mine.yaml"
    file.write_text(BLIND.replace("{vehicle", "{estimator: {coasting_after: 7000.0}, vehicle"))
    code = demo.main(["--scenario", str(file), "--out", str(tmp_path), "--composed", *sorted(set(ALL_NODES) - {"estimator"})])
    error = capfd.readouterr().err
    assert code == 2, error
    assert "estimator: coasting_after: 7000 is outside (0, 3600] s" in error and "Traceback" not in error


# -- nodes -----------------------------------------------------------------------------------------------------------

@pytest.fixture(scope="module")
def context():
    """An initialised default context, for nodes that are created in this process."""
    rclpy.init(args=[])
    yield
    rclpy.try_shutdown()


@pytest.mark.parametrize("node", NODES)
def test_every_node_refuses_a_parameter_that_it_does_not_have(node, context):
    create = importlib.import_module(f"{NODES[node]}.{node}_node").create
    with pytest.raises(ConfigError, match=f"{node}: no_such_gain: unknown parameter; "):
        create(cli_args=["--ros-args", "-p", "no_such_gain:=1.0"], use_global_arguments=False)


AS_A_USER = "estimator: coasting_after: 7000 is outside (0, 3600] s"
"""This executable is started as a user does; the others are forked from a process that has its code."""


@pytest.mark.parametrize("arguments, words", [
    (["-p", "coasting_after:=7000.0"], AS_A_USER),
    (["-p", "coasting_after:=often"], "estimator: coasting_after: 'often' is not of type float"),
    (["-p", "coastng_after:=0.9"], "estimator: coastng_after: unknown parameter; allowed: sensors, vio.position, vio.attitude, coasting_after"),
    (["--params-file", "/nowhere/gains.yaml"], "--params-file: /nowhere/gains.yaml: no such file"),
])
def test_an_executable_ends_with_one_line_and_exit_code_2(arguments, words, ros_domain):
    command = [executable("perch_perception", "estimator"), "--ros-args", *arguments]
    result = (subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE) if words == AS_A_USER else
              forks.run(forks.NODES, command, PATIENCE))
    assert result.returncode == 2
    assert words in result.stderr and result.stderr.startswith("error: ") and len(result.stderr.splitlines()) == 1


# -- requests --------------------------------------------------------------------------------------------------------

class Asker:
    """A node under test and its caller, on one executor in one process."""

    def __init__(self, module: str, *arguments: str) -> None:
        self._context = Context()
        rclpy.init(args=[], context=self._context)
        self.node = importlib.import_module(module).create(cli_args=["--ros-args", *arguments], use_global_arguments=False, context=self._context)
        self.caller = Node("asker", context=self._context)
        self._executor = EventsExecutor(context=self._context)
        self._executor.add_node(self.caller)
        connect([self.node], self._executor)

    def wait(self, done) -> None:
        """Handle what arrives until `done`."""
        for _ in range(int(PATIENCE / 0.05)):
            if done():
                return
            self._executor.spin_once(timeout_sec=0.05)
        raise AssertionError("no answer")

    def result(self, future):
        """The answer that a future will hold."""
        self.wait(future.done)
        return future.result()

    def close(self) -> None:
        """Leave the graph."""
        self._executor.shutdown()  # it holds the context, and so takes part in the graph
        close_nodes([self.node])
        self.caller.destroy_node()
        self._context.try_shutdown()


@pytest.fixture
def asker(ros_domain, request):
    """The node of the module that the test names as its parameter, with its arguments."""
    asker = Asker(*request.param)
    yield asker
    asker.close()


def plan_request() -> PlanPerch.Request:
    """A perch on a wall 1.7 m away, as the mission asks for it."""
    nan = math.nan
    request = PlanPerch.Request(impact_acceleration=nan, impact_speed_min=nan, impact_speed_max=nan, thrust_max=nan, thrust_min=nan)
    request.start_position.z, request.target.position.x, request.target.position.z = 1.2, 1.7, 1.2
    o = request.target.orientation
    o.x, o.y, o.z, o.w = 0.0, -math.sqrt(0.5), 0.0, math.sqrt(0.5)
    return request


def spoil(message, path: str, value: float) -> None:
    """Set a field of a message by its dotted path."""
    *groups, leaf = path.split(".")
    for group in groups:
        message = getattr(message, group)
    setattr(message, leaf, value)


@pytest.mark.parametrize("asker", [("perch_planner.perching_planner_node", "-p", "time_limit:=45.0")], indirect=True)
def test_the_planner_refuses_numbers_that_are_none_and_goes_on_working(asker):
    client = asker.caller.create_client(PlanPerch, "plan_perch")
    asker.wait(client.service_is_ready)
    for path, value in (("start_position.x", math.nan), ("start_velocity.z", math.inf), ("start_acceleration.y", math.nan),
                        ("start_jerk.x", math.nan), ("start_yaw", math.nan), ("target.position.y", math.nan),
                        ("target.orientation.w", math.nan), ("target.orientation.x", 3.0), ("target_velocity.x", math.nan),
                        ("thrust_max", -1.0), ("impact_speed_max", math.inf)):
        request = plan_request()
        spoil(request, path, value)
        answer = asker.result(client.call_async(request))
        assert not answer.success and answer.error_code == PlanPerch.Response.BAD_INPUT, (path, answer.message)
        assert any(word in answer.message for word in (str(value), f"{value:g}", "norm")), (path, answer.message)
        assert not answer.trajectory.segments
    assert asker.result(client.call_async(plan_request())).success


@pytest.mark.parametrize("asker", [("perch_control.mission_node",)], indirect=True)
def test_the_mission_refuses_goals_that_are_none(asker):
    client = ActionClient(asker.caller, Perch, "perch")
    asker.wait(client.server_is_ready)
    powerline = {"mode": Perch.Goal.MODE_POWERLINE}
    for fields, path, value, words in (
            ({}, "mode", 9, "mode: 9 is not one of 0 (surface)"), ({}, "takeoff_height", math.inf, "takeoff_height: inf is outside [0.3, 10] m"),
            ({}, "takeoff_height", 0.1, "takeoff_height: 0.1 is outside"), ({}, "search_timeout", -1.0, "search_timeout: -1 is outside [0.001, 300] s"),
            ({}, "inclination_hint", 7.0, "inclination_hint: 7 is outside [0, 3.14159] rad"),
            ({}, "search_pose.pose.position.x", math.nan, "search_position: nan is not finite"),
            ({}, "search_pose.pose.orientation.w", 0.2, "search_attitude: norm 0.2000 is not 1"),
            ({}, "search_pose.header.frame_id", "odom", "search_frame: 'odom' is not 'map'"),
            (powerline, "perch_point.z", math.nan, "perch_point: nan is not finite"), (powerline, "perch_pitch", math.nan, "perch_pitch: nan is")):
        goal = Perch.Goal(takeoff_height=math.nan, search_timeout=math.nan, inclination_hint=math.nan, **fields)
        if path.startswith("search_pose"):
            goal.search_pose.header.frame_id = "map"
            goal.search_pose.pose.position.z = 1.0
        spoil(goal, path, value)
        handle = asker.result(client.send_goal_async(goal))
        result = asker.result(handle.get_result_async()).result
        assert not result.success and result.error_code == Perch.Result.BAD_GOAL, (path, result)
        assert words in result.message, (path, result.message)
    client.destroy()


# -- a flight that is broken off -------------------------------------------------------------------------------------

@pytest.fixture
def airborne(tmp_path):
    """A demo that has climbed, and looks for a target, with all nodes in one process; and its nodes by name."""
    file = tmp_path / "blind.yaml"
    file.write_text(BLIND)
    process = subprocess.Popen(
        [sys.executable, "-u", "-m", "perch_eval.demo", "--scenario", str(file), "--out", str(tmp_path), "--composed"], env=dict(os.environ),
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        for line in process.stdout:
            if "searching" in line:
                break
        else:
            raise AssertionError(process.stderr.read())
        nodes = {}
        for child in psutil.Process(process.pid).children(recursive=True):
            nodes |= {Path(word).name: child for word in child.cmdline() if "/install/" in word}
        yield process, nodes
    finally:
        process.kill()
        process.communicate()


def check_recording(folder: Path) -> None:
    """The recording is readable and reaches into the flight."""
    flight = RecordedFlight(folder / "flight.mcap")
    assert len(flight.states("ground_truth/odometry").t) > 100 and len(flight.values("imu/data_raw")) > 100


def test_a_killed_node_ends_the_flight_and_is_named(tmp_path, undrawn, monkeypatch, capfd):
    """In this process, which hears what the demo prints; the nodes are forked."""
    forks.fork_programs(monkeypatch)
    stacks, nodes, heard = [], {}, []

    def hear(*words, **_):
        heard.append(" ".join(words))
        if "searching" in heard[-1] and not nodes:
            nodes.update({name: psutil.Process(pid) for name, pid in stacks[0].pids.items()})
            nodes["target_localizer"].kill()

    monkeypatch.setattr(demo, "Stack", lambda *arguments, **options: stacks.append(Stack(*arguments, **options)) or stacks[-1])
    monkeypatch.setattr(demo, "print", hear, raising=False)
    file = tmp_path / "blind.yaml"
    file.write_text(BLIND)
    code = demo.main(["--scenario", str(file), "--out", str(tmp_path), "--composed", *sorted(set(ALL_NODES) - {"target_localizer"})])
    assert (code, capfd.readouterr().err) == (1, "")
    assert set(nodes) == {"composed", "target_localizer"} and "target_localizer ended: killed by SIGKILL" in "\n".join(heard)
    assert not any(node.is_running() for node in nodes.values())
    check_recording(tmp_path)
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["outcome"] == "failed" and "target_localizer ended" in report["message"]
    assert "target_localizer ended" in (tmp_path / "report.html").read_text()


def test_an_interrupted_flight_leaves_nothing_running(airborne, tmp_path):
    process, nodes = airborne
    assert set(nodes) == {"composed"}
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=PATIENCE)
    assert (process.returncode, error) == (130, "interrupted; all nodes are stopped\n")
    assert not any(node.is_running() for node in nodes.values())
    logs = [log.read_text() for log in (tmp_path / "logs").glob("*.log")]
    assert logs and "Traceback" not in "".join(logs)
    check_recording(tmp_path)
