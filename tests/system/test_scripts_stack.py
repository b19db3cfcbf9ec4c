"""start_stack.py and run_node.py: what a user sees, also when things go wrong."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import time
from contextlib import suppress

import psutil
import pytest
from perch_eval.domain import reserved_domain
from system.scripts import PATIENCE, call_script, fork_script, run_script, start_script

NODES = ("estimator", "controller")  # they wait for a vehicle that does not come: no flight is needed here


@pytest.fixture
def domain():
    """A ROS domain that nobody else uses."""
    with reserved_domain() as number:
        yield str(number)


@pytest.fixture
def start(domain, tmp_path):
    """Starts start_stack.py with some nodes and waits until it says that they are ready."""
    processes: list[subprocess.Popen] = []

    def start(*arguments: str) -> subprocess.Popen:
        process = start_script("start_stack.py", "--only", *NODES, "--domain", domain, "--log-dir", str(tmp_path),
                               "--ready-timeout", str(PATIENCE), *arguments)
        processes.append(process)
        for line in process.stdout:
            if line.startswith("ready"):
                return process
        raise AssertionError(process.stderr.read())

    yield start
    for process in processes:
        process.kill()
        process.communicate()


def children(process: subprocess.Popen) -> dict[str, psutil.Process]:
    """The nodes that a start_stack.py has started, by name of the executable."""
    found = {}
    for child in psutil.Process(process.pid).children():
        with suppress(psutil.NoSuchProcess):  # it has ended, or is a zombie
            for word in child.cmdline():
                if "/install/" in word:
                    found[os.path.basename(word)] = child
    return found


def connected(port: int) -> socket.socket:
    """A connection to the viewer, which listens a moment after its node is visible."""
    end = time.monotonic() + PATIENCE
    while True:
        try:
            return socket.create_connection(("127.0.0.1", port), timeout=PATIENCE)
        except ConnectionRefusedError:
            assert time.monotonic() < end
            time.sleep(0.05)


@pytest.mark.parametrize("composed, number", [(False, signal.SIGINT), (True, signal.SIGTERM)], ids=["processes with a live view", "composed in a namespace"])
def test_ready_then_stopped_without_leftovers(start, tmp_path, composed, number):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    process = start("--composed", "--namespace", "/quad1") if composed else start("--view", str(port))
    started = children(process)
    assert set(started) == ({"composed"} if composed else {*NODES, "viewer"})
    if not composed:
        with connected(port) as client:
            client.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
                           b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Protocol: foxglove.sdk.v1\r\n\r\n")
            assert client.recv(200).startswith(b"HTTP/1.1 101")
    process.send_signal(number)
    out, error = process.communicate(timeout=PATIENCE)
    assert (process.returncode, error) == (0, "") and out.endswith("stopped\n")
    assert not any(child.is_running() for child in started.values())
    assert {file.name for file in tmp_path.glob("*.yaml")} == {f"{node}.yaml" for node in (NODES if composed else (*NODES, "viewer"))}
    logs = {file.stem: file.read_text() for file in tmp_path.glob("*.log")}
    assert set(logs) >= set(started) and "Traceback" not in "".join(logs.values())


def test_ctrl_c_during_start_up_ends_it(domain, tmp_path):
    process = start_script("start_stack.py", "--domain", domain, "--log-dir", str(tmp_path))
    try:
        while not (started := children(process)):
            assert process.poll() is None
        process.send_signal(signal.SIGINT)
        out, error = process.communicate(timeout=PATIENCE)
    finally:
        process.kill()
    assert (process.returncode, error) == (0, "") and out.endswith("stopped\n")
    assert not any(child.is_running() for child in started.values())


def test_a_killed_node_is_named_and_the_others_are_stopped(start):
    process = start()
    started = children(process)
    started["estimator"].kill()
    _, error = process.communicate(timeout=PATIENCE)
    assert process.returncode == 1
    assert "estimator ended: killed by SIGKILL" in error
    assert not started["controller"].is_running()


@pytest.mark.parametrize("arguments, words", [
    (["--scenario", "surface_900"], "surface_900: unknown; there are: "),
    (["--scenario", "/no/file.yaml"], "/no/file.yaml: no such file"),
    (["--only", "pilot"], "'pilot' is not one of vehicle"),
    (["--without", "vio_modell"], "'vio_modell' is not one of vehicle"),
    (["--only", "estimator", "-p", "controller.type:=nmpc"], "'controller', which is not started"),
    (["-p", "gain=2"], "expected NODE.PARAMETER:=VALUE"),
    (["--domain", "200"], "200 is outside [0, 101]"),
    (["--view", "70000"], "70000 is outside [0, 65535]"),
    (["--namespace", "quad1"], "must be '/' and a name"),
    (["--namespace", "/quad-1"], "must be '/' and a name"),
])
def test_mistakes_of_the_caller_are_one_clear_line(arguments, words, tmp_path):
    result = call_script("start_stack.py", *arguments, *([] if "--domain" in arguments else ["--domain", "1"]), "--log-dir", str(tmp_path))
    assert result.returncode == 2 and not list(tmp_path.glob("*.log")), "nothing is started"
    assert words in result.stderr and "Traceback" not in result.stderr + result.stdout


def test_a_parameter_that_a_node_refuses_is_invalid_input(domain, tmp_path):
    """What each node refuses is shown in test_bad_input.py."""
    result = run_script("start_stack.py", "--only", "estimator", "-p", "estimator.coasting_after:=7000.0", "--domain", domain, "--log-dir", str(tmp_path))
    assert result.returncode == 2
    assert "coasting_after: 7000 is outside" in result.stderr and "Traceback" not in result.stderr + result.stdout


def test_a_port_in_use_is_invalid_input(domain, tmp_path):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = str(taken.getsockname()[1])
        result = run_script("start_stack.py", "--only", "estimator", "--view", port, "--domain", domain, "--log-dir", str(tmp_path))
    assert result.returncode == 2 and "Traceback" not in result.stderr + result.stdout
    assert f"127.0.0.1:{port} cannot be served (Address already in use" in result.stderr and "choose another" in result.stderr


def test_a_single_node(domain):
    process = start_script("run_node.py", "estimator", "--ros-args", "-p", "coasting_after:=0.5", ROS_DOMAIN_ID=domain)
    try:
        answer = fork_script("param.py", "get", "/estimator", "coasting_after", "--spin-time", str(PATIENCE), ROS_DOMAIN_ID=domain)
        assert (answer.returncode, answer.stdout) == (0, "0.5\n")
        process.send_signal(signal.SIGINT)
        _, error = process.communicate(timeout=PATIENCE)
        assert process.returncode == 0 and "Traceback" not in error
    finally:
        process.kill()
    assert "'ghost' is not one of vehicle" in call_script("run_node.py", "ghost").stderr
