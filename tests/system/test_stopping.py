"""Every node's executable, alone, ends cleanly on SIGINT and on SIGTERM."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from pathlib import Path

import psutil
import pytest
import rclpy
from nodes.node_process import FREE
from perch_core import config
from perch_eval.node_launch import NODES
from perch_eval.nodes import executable
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter_client import AsyncParameterClient

PATIENCE = 300.0
"""For nodes to come up, compiled functions included, and to end; only ever waited for in full when a test fails [s]."""


class Watch:
    """Sees when nodes work: they answer to a request, which they do only once their constructor is through."""

    def __init__(self) -> None:
        self._context = Context()
        rclpy.init(args=[], context=self._context)
        self._node = Node("watch", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)

    def wait_for(self, name: str, process: subprocess.Popen) -> None:
        """Wait until a node answers."""
        client = AsyncParameterClient(self._node, name)
        end = time.monotonic() + PATIENCE
        self._until(client.services_are_ready, process, end)
        future = client.list_parameters([], 0)
        self._until(future.done, process, end)
        assert future.result().result.names

    def _until(self, done, process: subprocess.Popen, end: float) -> None:
        while not done():
            assert process.poll() is None, process.stderr.read()
            assert time.monotonic() < end, "the node does not answer"
            self._executor.spin_once(timeout_sec=0.02)

    def close(self) -> None:
        """Leave the graph."""
        self._node.destroy_node()
        self._context.try_shutdown()


def start(node: str, folder: Path) -> subprocess.Popen:
    """Start an executable with its parameter file, in a namespace where no other node is."""
    file = config.config_dir() / f"{node}.yaml"
    arguments = ["--ros-args", "-r", f"__ns:=/alone_{node}", *(["--params-file", str(file)] if file.exists() else [])]
    if node == "recorder":
        arguments += ["-p", f"file:={folder / 'flight.mcap'}"]
    if node == "viewer":
        arguments += ["-p", "port:=0"]
    return subprocess.Popen([executable(NODES[node].package, node), *arguments], env=dict(os.environ), stdin=subprocess.DEVNULL,
                            stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, cwd=folder)


def works(process: psutil.Process) -> bool:
    """Whether a process has not ended; one that only nobody has asked about yet (a zombie) has."""
    try:
        return process.status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


@pytest.mark.parametrize("number, names", [(signal.SIGINT, set(NODES)), (signal.SIGTERM, set(NODES) - set(FREE))])
def test_every_executable_stops_cleanly(number, names, ros_domain, tmp_path, record_property, capsys):
    """SIGTERM ends the others when the tests of `tests/nodes` are over, which assert it. SIGALRM: Fast DDS has waited for ever."""
    processes = {node: start(node, tmp_path) for node in NODES if node in names}
    durations, problems = {}, []
    watch = Watch()
    try:
        for node, process in processes.items():
            watch.wait_for(f"/alone_{node}/{node}", process)
        for node, process in processes.items():
            children = psutil.Process(process.pid).children(recursive=True)
            began = time.monotonic()
            process.send_signal(number)
            _, error = process.communicate(timeout=PATIENCE)
            durations[node] = time.monotonic() - began
            if process.returncode not in (0, -signal.SIGALRM) or "Traceback" in error:
                problems.append(f"{node}: exit code {process.returncode}: {error}")
            while any(map(works, children)) and time.monotonic() - began < PATIENCE:
                time.sleep(0.02)
            problems += [f"{node} leaves {child}" for child in children if works(child)]
    finally:
        watch.close()
        for process in processes.values():
            process.kill()
            process.wait()
    record_property("stopped_after_s", durations)
    with capsys.disabled():
        print(f"\n{number.name}: " + ", ".join(f"{node} {1e3 * s:.0f} ms" for node, s in durations.items()))
    assert not problems, "\n".join(problems)
