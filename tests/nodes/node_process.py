"""Starts executables of nodes, each in a process of its own, and plain scripts beside them."""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import rclpy
from perch_sim.scenario import NODES
from perch_eval.nodes import executable
from rcl_interfaces.srv import ListParameters
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from system import forks

PLAIN = Path(__file__).parent / "plain"
FREE = ("estimator", "vio", "target_localizer", "powerline_mapper", "controller", "perching_planner", "powerline_planner", "mission", "description")
"""Every node but those of simulation and evaluation."""
PATIENCE = 300.0  # only ever waited for in full when a test fails [s]


class Running:
    """One executable. Its output goes into a file: nobody reads a pipe that a node may fill."""

    def __init__(self, name: str, folder: Path, namespace: str, parameters: Mapping[str, object]) -> None:
        self.name, self.domain = f"{namespace}/{name}", os.environ["ROS_DOMAIN_ID"]
        self._log = folder / f"{name}.log"
        given = [part for key, value in parameters.items() for part in ("-p", f"{key}:={value}")]
        with self._log.open("w") as file:
            self.process = forks.Forked(
                forks.NODES, [executable(NODES[name], name), "--ros-args", "-r", f"__ns:={namespace or '/'}", *given], file, file)

    @property
    def log(self) -> str:
        """All that it has written."""
        return self._log.read_text()

    def check(self) -> None:
        """It works, and has met no defect of its own."""
        assert self.process.poll() is None, f"{self.name} has ended:\n{self.log[-3000:]}"
        assert "defect" not in self.log and "Traceback" not in self.log, f"{self.name}:\n{self.log[-3000:]}"

    def ended(self) -> str:
        """What is wrong with how it ended upon SIGTERM; where Fast DDS waits for ever, SIGALRM ends it."""
        code = self.process.wait(timeout=PATIENCE)
        return "" if code in (0, -signal.SIGALRM) and "Traceback" not in self.log else f"{self.name} ended with exit code {code}:\n{self.log[-3000:]}"


@contextmanager
def nodes(names: Collection[str], folder: Path, namespaces: Mapping[str, str] | None = None,
          parameters: Mapping[str, Mapping[str, object]] | None = None) -> Iterator[dict[str, Running]]:
    """Executables, alone with their parameters; all of them work, and are stopped afterwards.

    Args:
        names: of the nodes.
        folder: receives their logs.
        namespaces: node -> namespace, as in `/lines`, where it is not the root.
        parameters: node -> parameter -> value in YAML.
    """
    running: dict[str, Running] = {}
    try:
        for name in names:
            running[name] = Running(name, folder, (namespaces or {}).get(name, ""), (parameters or {}).get(name, {}))
        wait_for(running.values())
        yield running
    finally:
        for node in running.values():
            node.process.terminate()
        problems = [problem for node in running.values() if (problem := node.ended())]
    assert not problems, "\n".join(problems)


@contextmanager
def watching() -> Iterator[tuple[Node, SingleThreadedExecutor]]:
    """A node of this process beside those of the domain, and what runs its callbacks."""
    context = Context()
    rclpy.init(args=[], context=context)
    node = Node("watch", context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    try:
        yield node, executor
    finally:
        node.destroy_node()
        context.try_shutdown()


def wait_for(running: Collection[Running]) -> None:
    """Wait until every node is in the graph with its services, which it offers when it works."""
    with watching() as (node, executor):
        missing = {one: node.create_client(ListParameters, f"{one.name}/list_parameters") for one in running}
        for _ in range(round(PATIENCE / 0.05)):
            missing = {one: client for one, client in missing.items() if not client.service_is_ready()}
            if not missing:
                return
            for one in missing:
                one.check()
            executor.spin_once(timeout_sec=0.05)
        raise AssertionError(f"{', '.join(one.name for one in missing)} did not come up")


def set_parameter(running: Collection[Running], name: str, value: object) -> None:
    """Set a parameter of several nodes, each of which accepts it."""
    with watching() as (node, executor):
        clients = [AsyncParameterClient(node, one.name) for one in running]
        for client in clients:
            end = time.monotonic() + PATIENCE
            while not client.services_are_ready():
                assert time.monotonic() < end, "a node does not offer its parameters"
                executor.spin_once(timeout_sec=0.02)
            future = client.set_parameters([Parameter(name, value=value)])
            executor.spin_until_future_complete(future, PATIENCE)
            assert [result.successful for result in future.result().results] == [True]


def plain(script: str, *arguments: str) -> dict:
    """What a script of `plain/` prints; it may import nothing of perch but messages."""
    done = forks.run(forks.SCRIPTS, [str(PLAIN / script), *arguments], PATIENCE)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])  # the middleware may have complained before
