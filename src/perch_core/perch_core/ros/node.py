"""Executables of nodes: a component as a node, alone or together with others in one process."""

from __future__ import annotations

import inspect
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any, NoReturn

from perch_core.ros.component_node import ComponentNode  # first: it sets the threads of numpy  # isort: skip
import rclpy
from perch_core.component import Component
from perch_core.errors import ConfigError, PerchError
from perch_core.processes import end_within, freeze_heap
from perch_core.registry import resolved
from perch_core.ros.arrival import ArrivalNode
from perch_core.ros.priority import priority
from perch_core.ros.ros_init import init_ros
from perch_core.ros.wiring import Wiring
from perch_core.yaml_text import read_yaml
from rclpy.clock import Clock, ClockType
from rclpy.executors import Executor
from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from rclpy.task import Future

CHECK_PERIOD = 0.1     # of the check for a stop signal, wall clock [s]
SHUTDOWN_TIMEOUT = 20  # for the end of a process after its stop signal [s]
REAL_TIME = "perch_core.ros.arrival:ArrivalNode"
LOCKSTEP = "perch_sim.ros.participant_node:ParticipantNode"  # the simulator's host: perch_core's only reference to it


@dataclass(frozen=True)
class NodeSpec:
    """A node that can be started.

    Node files have `NODE = NodeSpec("controller", Controller)` and `create, main = NODE.create, NODE.main`.

    Attributes:
        name: name of the node and its executable.
        component: class of the component.
        choose: returns the class for the parameter `type`, where there are several.
        deadline: output whose answers have a deadline in real time; empty: none.
        lockstep, real_time: class of the node in lockstep and otherwise, `module:class`.
    """

    name: str
    component: type[Component[Any]]
    deadline: str = ""
    lockstep: str = LOCKSTEP
    choose: Callable[[str], type[Component[Any]]] | None = None
    real_time: str = REAL_TIME

    def create(self, wiring: Wiring | None = None, **kwargs: Any) -> ComponentNode:
        """Create the node, with the host that the parameter `lockstep` selects. `kwargs` go to `rclpy.node.Node`.

        Raises:
            ConfigError: a parameter is refused.
        """
        with _selecting_parameters(self.name, kwargs, {"lockstep": bool, "type": str}) as values:
            wiring = wiring or Wiring()
            component = self.choose(values["type"]) if self.choose is not None and "type" in values else self.component
            if values.get("lockstep"):
                lockstep: type[ComponentNode] = resolved(self.lockstep)
                return lockstep(self.name, component, wiring, **kwargs)
            real_time: type[ArrivalNode] = resolved(self.real_time)
            return real_time(self.name, component, wiring, deadline=self.deadline, **kwargs)

    def main(self) -> None:
        """Entry point of the executable: run until SIGINT or SIGTERM; exit code 0, or 2 when parameters are refused."""
        run(lambda wiring: [self.create(wiring)], None)


@contextmanager
def _selecting_parameters(name: str, kwargs: dict[str, Any], kinds: dict[str, type]) -> Iterator[dict[str, Any]]:
    """Yield the given values of the parameters that decide the node's class, read from a probe node of the same name.

    The probe ends before the node is created: two nodes of one name are one in the graph, and the publishers of the node would
    leave it with the probe. Another node lives until the node exists: without it, the end of the probe would be that of
    the process's participant, and Fast DDS may wait for ever where a participant ends while it discovers others.
    """
    plain: dict[str, Any] = {"enable_rosout": False, "start_parameter_services": False}
    keeper = Node(f"_{name}_starting", use_global_arguments=False, context=kwargs.get("context"), **plain)
    try:
        probe = Node(name, **plain, **{k: v for k, v in kwargs.items() if k != "wiring"})
        values = {key: parameter.value for key, parameter in probe._parameter_overrides.items() if key in kinds}
        probe.destroy_node()
        for key, value in values.items():
            if not isinstance(value, kinds[key]):
                raise ConfigError(name, key, f"{value!r} is not of type {kinds[key].__name__}")
        yield values
    finally:
        keeper.destroy_node()


class StopSignal:
    """Flag that becomes true on SIGINT or SIGTERM.

    rclpy's own handlers raise an exception in the running callback, which EventsExecutor cannot propagate; a flag lets the
    callback finish. Until `defer` is set, no callback of ROS runs, and a signal ends the process at once by SystemExit.
    Python's messages about ignored exceptions are then suppressed: where C code has called Python (as numba does to load its
    cache), SystemExit is lost and the flag ends the process; objects under construction fail when they are deleted.
    """

    def __init__(self) -> None:
        self._set = self.defer = False
        hook, sys.unraisablehook = sys.unraisablehook, lambda error: None if self and not self.defer else hook(error)
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._handle)

    def _handle(self, *_: Any) -> None:
        self._set = True
        if not self.defer:
            raise SystemExit(0)

    def __bool__(self) -> bool:
        return self._set


def spin_until_stopped(executor: Executor, stop: StopSignal, on_failure: Callable[[str, Exception], None] | None = None) -> None:
    """Run callbacks until the stop signal.

    Args:
        executor: its first node gets a timer.
        stop: the signal.
        on_failure: called with `executor` and an exception that leaves a callback; the executor then continues; messages that
            waited with it are handled when others arrive. None: it is raised.

    EventsExecutor.spin() does not return on shutdown in rclpy 7.1.6, and spin_once() restarts for every message, which
    costs 30 us each. Therefore this function waits for a future, 0.1 s at a time. The executor checks this time-out only when no
    callback is pending, which in lockstep may never be the case: a timer completes the future.
    """
    stopped = Future()

    def check_stop() -> None:
        if stop and not stopped.done():
            stopped.set_result(None)

    next(iter(executor.get_nodes())).create_timer(CHECK_PERIOD, check_stop, clock=Clock(clock_type=ClockType.STEADY_TIME))
    while not stop and rclpy.ok():
        try:
            executor.spin_until_future_complete(stopped, timeout_sec=CHECK_PERIOD)
        except Exception as error:
            if on_failure is None:
                raise
            on_failure("executor", error)
            time.sleep(0.001)  # one that fails at once, each time, leaves time for other threads


def connect(nodes: Sequence[ComponentNode], executor: Any) -> None:
    """Connect nodes that share a process, when all of them exist."""
    for one in nodes:
        one.use_local_clock()
        executor.add_node(one)
        one.connect()
    for one in nodes:
        one.wiring.run_on(executor)


def close_nodes(nodes: Sequence[ComponentNode]) -> None:
    """Release threads, processes and files of all nodes, last node first, then destroy the nodes, even if one raises."""
    with ExitStack() as stack:
        for one in nodes:
            stack.callback(one.destroy_node)
        for one in nodes:
            stack.callback(one.close)


def run(create: Callable[[Wiring], Sequence[ComponentNode]], args: list[str] | None) -> NoReturn:
    """Run the nodes that `create` returns until SIGINT or SIGTERM.

    Exit code 0, or 2 when a parameter is refused. Fast DDS 2.14 may wait for ever where a participant ends while one of its
    readers is notified of a message, even in the C library's exit: after `SHUTDOWN_TIMEOUT`, SIGALRM ends the process.
    """
    nodes: list[ComponentNode] = []
    stop = StopSignal()
    try:
        arguments = sys.argv if args is None else args
        _check_parameter_files(arguments)
        init_ros(args)
        nodes += create(Wiring())
        _warn_unused_parameter_files(arguments, nodes)
        priority.nodes = len(nodes)
        executor = EventsExecutor()
        connect(nodes, executor)
        inspect.getmodule(inspect.currentframe())  # the first line of a log looks for the files of all modules: 0.1 s
        freeze_heap()
        for one in nodes:
            if isinstance(one, ArrivalNode):
                one.wiring.from_thread(one.request_real_time)  # while it spins: the executor's threads are raised, too
        stop.defer = True
        spin_until_stopped(executor, stop, nodes[0].log_refusal)
    except (PerchError, rclpy.exceptions.InvalidParameterValueException, rclpy.exceptions.InvalidParameterTypeException) as error:
        _refuse(str(error))
    except RuntimeError as error:
        if nodes:
            raise
        _refuse(" ".join(str(error).split()))  # rcl refuses command lines and parameter files with this one
    finally:
        end_within(SHUTDOWN_TIMEOUT)
        close_nodes(nodes)
        rclpy.try_shutdown()
    sys.exit(0)


def _check_parameter_files(arguments: Sequence[str]) -> None:
    """Raise ConfigError for a missing parameter file: rcl's own message includes a line of its C code."""
    for file in _parameter_files(arguments):
        if not os.path.isfile(file):
            raise ConfigError("--params-file", file, "no such file")


def _warn_unused_parameter_files(arguments: Sequence[str], nodes: Sequence[Node]) -> None:
    """Warn of each parameter file without a section for one of the nodes: rcl ignores it."""
    names = [one.get_fully_qualified_name() for one in nodes]
    for file in _parameter_files(arguments):
        try:
            sections = list(_sections(read_yaml(file)))
        except ConfigError:  # rcl, which is less strict, has accepted it
            continue
        if not any(fnmatchcase(name, section.replace("/**", "*")) for name in names for section in sections):
            nodes[0].get_logger().warning(f"{file}: not used: its sections are {', '.join(sections)}, none of which is {' or '.join(names)}")


def _parameter_files(arguments: Sequence[str]) -> list[str]:
    return [file for option, file in zip(arguments, arguments[1:]) if option == "--params-file"]


def _sections(content: Any, name: str = "") -> Iterator[str]:
    """Yield the fully qualified names, which may have wildcards, of the nodes for which a parameter file has values."""
    for key, value in content.items() if isinstance(content, dict) else ():
        if key == "ros__parameters":
            yield name
        else:
            yield from _sections(value, f"{name}/{str(key).strip('/')}")


def _refuse(problem: str) -> NoReturn:
    print(f"error: {problem}", file=sys.stderr)
    rclpy.try_shutdown()
    sys.exit(2)
