"""Ctrl-C while scripts come up: it is never lost, and leaves no traceback."""

from __future__ import annotations

import ctypes
import gc
import importlib
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
from perch_eval.nodes import executable
from perch_eval.program import Program
from perch_eval.stack import Stack

SCRIPTS = Path(__file__).resolve().parents[2] / "scripts"


@pytest.fixture
def connect(monkeypatch, ros_domain):
    """`ros_graph.connection.connect`, of the scripts."""
    monkeypatch.syspath_prepend(str(SCRIPTS))
    from ros_graph.connection import connect

    return connect


def test_ctrl_c_ends_the_wait_for_nodes(connect, tmp_path):
    loading = Program("loading", (sys.executable, "-S", "-c", "import time; time.sleep(1000)"), ("/loading",))
    with Stack([loading], tmp_path) as stack, pytest.raises(KeyboardInterrupt), connect() as graph:
        signal.raise_signal(signal.SIGINT)
        stack.wait_until_ready(graph.visible_nodes, timeout=60.0)
    assert stack.pids == {}


def test_ctrl_c_that_nobody_looked_for_counts_at_the_end_of_the_connection(connect):
    with pytest.raises(KeyboardInterrupt), connect():
        signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.parametrize("rate", [1000.0, 1e9])
def test_ctrl_c_ends_publishing_also_at_a_rate_that_is_too_high_and_waits_are_periods(monkeypatch, connect, rate):
    topics, published, waits = importlib.import_module("ros_graph.topics"), [], []
    arguments = SimpleNamespace(type="std_msgs/msg/Empty", values="", topic="/x", once=False, rate=rate)

    def publish(message):
        published.append(message)
        assert len(published) < 100
        if len(published) == 10:
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt), connect() as graph:
        monkeypatch.setattr(graph.node, "create_publisher", lambda *_: SimpleNamespace(publish=publish))
        monkeypatch.setattr(graph, "spin_for", lambda wait: (waits.append(wait), time.sleep(max(0.0, wait))))
        topics.publish(graph, arguments)
    assert len(published) == 10 and max(waits) <= 1.0 / rate


@pytest.mark.parametrize("accepted", [True, False])
def test_ctrl_c_before_a_goal_is_accepted_cancels_it_once_it_is(monkeypatch, connect, accepted):
    calls = importlib.import_module("ros_graph.calls")
    answers, cancelled = [KeyboardInterrupt, SimpleNamespace(accepted=accepted, cancel_goal_async=lambda: "cancel"), None], []

    def answer(future, what, timeout=10.0):
        cancelled.extend(["cancel"] if future == "cancel" else [])
        if (found := answers.pop(0)) is KeyboardInterrupt:
            raise KeyboardInterrupt
        return found

    graph = SimpleNamespace(node=None, absolute=str, spin_until=lambda *_: True, answer=answer)
    monkeypatch.setattr(calls, "ActionClient", lambda *_: SimpleNamespace(server_is_ready=None, send_goal_async=lambda *_, **__: "sent"))
    arguments = SimpleNamespace(type="perch_msgs/action/Perch", values="", action="/perch", spin_time=1.0, feedback=False)
    with pytest.raises(KeyboardInterrupt):
        calls.send_goal(graph, arguments)
    assert cancelled == ["cancel"] * accepted


def test_ctrl_c_ends_a_search_by_the_exit_code_of_all_scripts(monkeypatch, tmp_path, capsys):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.syspath_prepend(str(SCRIPTS))
    script = importlib.import_module("fuzz")
    monkeypatch.setattr(script, "enter", lambda: None)
    monkeypatch.setattr("fuzzing.files.run", interrupted)
    monkeypatch.setattr(sys, "argv", ["fuzz.py", "files", "--cases", str(tmp_path)])
    assert script.main() == 130 and "0 problems" in capsys.readouterr().out


def test_ctrl_c_while_modules_are_loaded_leaves_no_traceback():
    code = f"""
import sys, time
sys.path.insert(0, {str(SCRIPTS)!r})
from perch_setup import quiet_on_interrupt
with quiet_on_interrupt():
    print("loading", flush=True)
    while True:
        time.sleep(0.01)  # a signal just before `pause` would be waited for in vain
"""
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "loading\n"
    process.send_signal(signal.SIGINT)
    out, error = process.communicate(timeout=60.0)
    assert (process.returncode, error) == (130, "")


def test_ctrl_c_that_was_blocked_and_ignored_reaches_a_handler_that_is_set_later():
    """As for `run_node.py ... &` in a shell script, in which rclpy's own nodes end on SIGINT, too."""
    code = """
import os, signal, sys
signal.signal(signal.SIGINT, signal.SIG_IGN)
signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
from perch_core.interrupts import quiet_on_interrupt
with quiet_on_interrupt():
    os.kill(os.getpid(), signal.SIGINT)
from perch_core.ros.node import StopSignal
stop = StopSignal()
os.kill(os.getpid(), signal.SIGINT)
sys.exit(7)
"""
    assert subprocess.run([sys.executable, "-c", code], timeout=300.0).returncode == 0


def interrupted_once(process: subprocess.Popen, file: str, pattern: str) -> str:
    """What a process says after SIGINT at the moment when a pattern is found in a file of its /proc."""
    place, end = Path(f"/proc/{process.pid}/{file}"), time.monotonic() + 60.0
    while not re.search(pattern, place.read_text()) and process.poll() is None:
        if time.monotonic() > end:
            process.kill()
            pytest.fail(f"{pattern!r} not in {place} for 60 s")
        time.sleep(0.001)
    process.send_signal(signal.SIGINT)
    said = process.communicate(timeout=60.0)[1]
    assert process.returncode in (0, 130), said  # 0: it has begun to be a node
    return said


CONTROLLER = executable("perch_control", "controller")


@pytest.mark.parametrize("file, pattern", [
    ("cmdline", re.escape(f"{sys.executable}\0{SCRIPTS}") + "|" + re.escape(CONTROLLER)), ("cmdline", re.escape(CONTROLLER)),
    ("maps", "_multiarray_umath"), ("maps", "_rclpy_pybind11")])
def test_ctrl_c_while_run_node_starts_leaves_no_traceback(ros_domain, file, pattern):
    command = [sys.executable, "-S", str(SCRIPTS / "run_node.py"), "controller"]
    assert "Traceback" not in interrupted_once(subprocess.Popen(command, stderr=subprocess.PIPE, text=True), file, pattern)


@pytest.mark.parametrize("pattern", ["_multiarray_umath", "_rclpy_pybind11"])
def test_ctrl_c_while_an_executable_loads_leaves_no_traceback(ros_domain, pattern):
    assert "Traceback" not in interrupted_once(subprocess.Popen([CONTROLLER], stderr=subprocess.PIPE, text=True), "maps", pattern)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_at_the_start_is_kept_without_a_traceback(monkeypatch, capfd, number):
    """While C code calls Python, as numba does to load what is compiled, and in the middle of making an object that frees what it has."""
    from perch_core.ros.node import StopSignal

    class Handle:
        def __init__(self):
            signal.raise_signal(number)
            self.pointer = 0

        def __del__(self):
            self.pointer += 1

    monkeypatch.setattr(sys, "unraisablehook", sys.__unraisablehook__)
    former = {each: signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)}
    try:
        stop = StopSignal()
        ctypes.CFUNCTYPE(None)(lambda: signal.raise_signal(number))()
        assert stop
        with pytest.raises(SystemExit):
            Handle()
        gc.collect()
        assert capfd.readouterr().err == ""
        stop.defer = True
        Handle.__new__(Handle)  # from now on an error is one
        gc.collect()
        assert "pointer" in capfd.readouterr().err
    finally:
        for each, handler in former.items():
            signal.signal(each, handler)
