"""topic.py, param.py, service.py and action.py against a live node."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import yaml
from perch_eval.domain import reserved_domain
from system.scripts import PATIENCE, fork_script, start_script


@pytest.fixture(scope="module")
def peer():
    """A node to talk to, in a domain of its own."""
    with reserved_domain() as domain:
        environment = {"ROS_DOMAIN_ID": str(domain)}
        process = subprocess.Popen(
            [sys.executable, str(Path(__file__).with_name("peer_node.py"))], env={**os.environ, **environment},
            stdout=subprocess.PIPE, text=True)
        try:
            assert process.stdout.readline().startswith("up")
            yield environment
        finally:
            process.terminate()
            process.wait(PATIENCE)


def eventually(condition) -> None:
    """Lists show what discovery has found so far, which on a busy machine is not yet everything."""
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end, "waited in vain"


@pytest.fixture
def run(peer):
    """Runs a script in the domain of the node."""
    return lambda *arguments: fork_script(*arguments, "--spin-time", "30", **peer)


def test_topics_are_listed_with_types(run):
    eventually(lambda: "/points [geometry_msgs/msg/PointStamped]" in run("topic.py", "list", "-t").stdout.splitlines())


def test_echo_shows_messages_of_a_best_effort_publisher(run):
    result = run("topic.py", "echo", "/points", "--once")
    message, end = result.stdout.rsplit("---", 1)
    assert result.returncode == 0 and end == "\n"
    assert yaml.safe_load(message)["header"]["frame_id"] == "map"

    numbers = [float(line) for line in run("topic.py", "echo", "points", "-n", "3", "--field", "point.x").stdout.split("---\n")[:-1]]
    assert len(numbers) == 3 and numbers == sorted(set(numbers))


def test_echo_of_a_field_that_does_not_exist(run):
    result = run("topic.py", "echo", "points", "--field", "point.w")
    assert result.returncode == 2
    assert result.stderr == "error: --field point.w: 'w' does not exist; there are: x, y, z\n"


def test_a_topic_that_does_not_exist_is_invalid_input(peer):
    result = fork_script("topic.py", "echo", "/nothing", "--spin-time", "0.1", **peer)
    assert result.returncode == 2 and "topic /nothing does not exist in ROS domain" in result.stderr
    assert len(result.stderr.splitlines()) == 1


def test_rate(run):
    result = run("topic.py", "hz", "/points", "-n", "20")
    assert result.returncode == 0
    assert "average rate: " in result.stdout and "window: 20" in result.stdout


def test_info_names_nodes_and_qos(run):
    result = run("topic.py", "info", "/points", "-v")
    assert "Type: geometry_msgs/msg/PointStamped" in result.stdout and "Publisher count: 1" in result.stdout
    assert "Node: /peer  reliability: BEST_EFFORT  durability: VOLATILE" in result.stdout


def test_published_messages_arrive_and_latched_ones_are_echoed(run):
    assert run("topic.py", "pub", "--once", "/say", "std_msgs/String", "{data: hello}").returncode == 0
    assert run("topic.py", "echo", "/heard", "--once", "--field", "data").stdout == "heard hello\n---\n"


def test_parameters(run):
    assert run("param.py", "get", "/peer", "gain").stdout == "2.0\n"
    assert "  gain\n" in run("param.py", "list", "peer").stdout
    eventually(lambda: run("param.py", "list").stdout.startswith("/peer:\n  gain\n"))  # of all nodes, but /bare has none
    assert run("param.py", "describe", "peer", "gain", "use_sim_time").stdout.startswith("gain: 2.0\n")
    accepted = run("param.py", "set", "/peer", "gain", "3")  # an integer for a double
    assert (accepted.returncode, accepted.stdout) == (0, "/peer: gain is now 3.0\n")
    refused = run("param.py", "set", "/peer", "gain", "-1")
    assert refused.returncode == 1 and "gain must be > 0" in refused.stdout
    assert yaml.safe_load(run("param.py", "dump", "/peer").stdout)["/peer"]["ros__parameters"]["gain"] == 3.0
    unknown = run("param.py", "get", "/peer", "gian")
    assert unknown.returncode == 2 and "gian" in unknown.stderr
    unknown = run("param.py", "describe", "/peer", "gain", "gian")
    assert (unknown.returncode, unknown.stderr) == (2, "error: /peer does not have gian; 'param.py list /peer' shows all\n")
    run("param.py", "set", "/peer", "gain", "2.0")


@pytest.mark.parametrize("node", ["/ghost", "/bare"])
def test_a_node_that_does_not_exist_or_has_no_parameters(peer, node):
    result = fork_script("param.py", "get", node, "gain", "--spin-time", "1", **peer)
    assert result.returncode == 2 and f"node {node} does not exist or has no parameters; nodes that have: " in result.stderr
    assert node not in result.stderr.partition("nodes that have: ")[2]


def test_services(run):
    eventually(lambda: "/arm [std_srvs/srv/SetBool]" in run("service.py", "list", "-t").stdout.splitlines())
    good = run("service.py", "call", "/arm", "std_srvs/srv/SetBool", "{data: true}")
    assert good.returncode == 0 and yaml.safe_load(good.stdout) == {"success": True, "message": "armed"}
    assert run("service.py", "call", "/arm", "std_srvs/srv/SetBool").returncode == 1
    wrong = run("service.py", "call", "/arm", "std_srvs/srv/SetBool", "{data: 1}")
    assert wrong.returncode == 2 and "data: 1 does not fit boolean" in wrong.stderr


def test_a_goal_that_succeeds(run):
    eventually(lambda: "/perch [perch_msgs/action/Perch]" in run("action.py", "list", "-t").stdout.splitlines())
    result = run("action.py", "send_goal", "/perch", "perch_msgs/action/Perch", "{takeoff_height: 1}", "--feedback")
    assert result.returncode == 0
    assert "phase: tracking" in result.stdout and "message: perched" in result.stdout and "SUCCEEDED" in result.stdout


def test_interrupting_send_goal_cancels_the_goal(peer):
    process = start_script("action.py", "send_goal", "/perch", "perch_msgs/action/Perch", "{takeoff_height: 2}",
                           "--spin-time", "30", **peer)
    assert process.stdout.readline() == "goal accepted\n"
    process.send_signal(signal.SIGINT)
    out, error = process.communicate(timeout=PATIENCE)
    assert "message: cancelled" in out and "CANCELED" in out and "Traceback" not in error
    assert process.returncode == 130


def test_interrupting_echo_is_quiet(peer):
    process = start_script("topic.py", "echo", "/points", "--spin-time", "30", **peer)
    assert process.stdout.readline()
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=PATIENCE)
    assert error == "" and process.returncode == 130
