"""Every node's executable, alone, ends cleanly on SIGINT and on SIGTERM.

One is started as a user does; the others are forked from a process that has their code, and run the same files.
"""

from __future__ import annotations

import signal
import subprocess
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import psutil
import pytest
from nodes.node_process import FREE, watching
from perch_core import config
from perch_sim.scenario import NODES
from perch_eval.nodes import executable
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter_client import AsyncParameterClient
from system import forks

PATIENCE = 300.0
"""For nodes to come up, compiled functions included, and to end; only ever waited for in full when a test fails [s]."""

AS_A_USER = "vehicle"


class Watch:
    """Sees when nodes work: they answer to a request, which they do only once their constructor is through."""

    def __init__(self, node: Node, executor: SingleThreadedExecutor) -> None:
        self._node, self._executor = node, executor

    def wait_for(self, name: str, process: Executable) -> None:
        """Wait until a node answers."""
        client = AsyncParameterClient(self._node, name)
        end = time.monotonic() + PATIENCE
        self._until(client.services_are_ready, process, end)
        future = client.list_parameters([], 0)
        self._until(future.done, process, end)
        assert future.result().result.names

    def _until(self, done, process: Executable, end: float) -> None:
        while not done():
            assert process.process.poll() is None, process.said
            assert time.monotonic() < end, "the node does not answer"
            self._executor.spin_once(timeout_sec=0.02)


@pytest.fixture
def watch(ros_domain: int) -> Iterator[Watch]:
    """In the domain of the test."""
    with watching() as (node, executor):
        yield Watch(node, executor)


class Executable:
    """One process of a node, whose output goes into a file."""

    def __init__(self, command: Sequence[str], log: Path, forked: bool) -> None:
        self._log = log
        with log.open("w") as file:
            self.process = (forks.Forked(forks.NODES, command, file, file) if forked else
                            subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=file, stderr=file))

    @property
    def said(self) -> str:
        """All that it has written."""
        return self._log.read_text()


def start(node: str, folder: Path) -> Executable:
    """Start an executable with its parameter file, in a namespace where no other node is."""
    file = config.config_dir() / f"{node}.yaml"
    arguments = ["--ros-args", "-r", f"__ns:=/alone_{node}", *(["--params-file", str(file)] if file.exists() else [])]
    if node == "recorder":
        arguments += ["-p", f"file:={folder / 'flight.mcap'}"]
    if node == "viewer":
        arguments += ["-p", "port:=0"]
    return Executable([executable(NODES[node], node), *arguments], folder / f"{node}.log", node != AS_A_USER)


def works(process: psutil.Process) -> bool:
    """Whether a process has not ended; one that only nobody has asked about yet (a zombie) has."""
    try:
        return process.status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


@pytest.mark.parametrize("number, names", [(signal.SIGINT, set(NODES)), (signal.SIGTERM, set(NODES) - set(FREE))])
def test_every_executable_stops_cleanly(number, names, watch, tmp_path, record_property, capsys):
    """SIGTERM ends the others when the tests of `tests/nodes` are over, which assert it. SIGALRM: Fast DDS has waited for ever."""
    processes = {node: start(node, tmp_path) for node in NODES if node in names}
    durations, problems = {}, []
    try:
        for node, process in processes.items():
            watch.wait_for(f"/alone_{node}/{node}", process)
        for node, process in processes.items():
            children = psutil.Process(process.process.pid).children(recursive=True)
            began = time.monotonic()
            process.process.send_signal(number)
            code = process.process.wait(PATIENCE)
            durations[node] = time.monotonic() - began
            if code not in (0, -signal.SIGALRM) or "Traceback" in process.said:
                problems.append(f"{node}: exit code {code}: {process.said}")
            while any(map(works, children)) and time.monotonic() - began < PATIENCE:
                time.sleep(0.02)
            problems += [f"{node} leaves {child}" for child in children if works(child)]
    finally:
        for process in processes.values():
            process.process.kill()
            process.process.wait(PATIENCE)
    record_property("stopped_after_s", durations)
    with capsys.disabled():
        print(f"\n{number.name}: " + ", ".join(f"{node} {1e3 * s:.0f} ms" for node, s in durations.items()))
    assert not problems, "\n".join(problems)
