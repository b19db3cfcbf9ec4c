"""A temporary node in a running graph, in a ROS context of its own; its callbacks run while its owner waits."""

from __future__ import annotations

import math
import signal
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

from perch_core.ros.ros_init import init_ros
from rclpy.context import Context
from rclpy.experimental import EventsExecutor
from rclpy.node import Node

T = TypeVar("T")
SLICE = 0.05  # of a wait, after which an interrupt counts [s]


class GraphNode:
    """The node. An interrupt ends its present wait, or the next one: an exception out of a signal handler would end in rclpy's C++.

    Attributes:
        node: for publishers, subscriptions and clients.
    """

    def __init__(self, name: str, arguments: Sequence[str] = (), interrupts: Sequence[signal.Signals] = (signal.SIGINT,)) -> None:
        """
        Args:
            name: of the node.
            arguments: ROS arguments.
            interrupts: signals that are a KeyboardInterrupt of the main thread's wait.
        """
        self._context = Context()
        init_ros([], self._context)
        self.node = Node(name, context=self._context, cli_args=["--ros-args", *arguments], start_parameter_services=False, enable_rosout=False)
        self._executor = EventsExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._interrupted = False
        main = threading.current_thread() is threading.main_thread()
        self._handlers: dict[signal.Signals, Any] = {one: signal.signal(one, self._interrupt) for one in interrupts if main}

    def _interrupt(self, *_: object) -> None:
        self._interrupted = True

    def check(self) -> None:
        """Raise KeyboardInterrupt where an interrupt has come."""
        if self._interrupted:
            self._interrupted = False
            raise KeyboardInterrupt

    def spin(self, timeout: float) -> None:
        """Run what has come, or comes in time [s].

        Raises:
            KeyboardInterrupt: an interrupt has come.
        """
        self._executor.spin_once(timeout_sec=timeout)
        self.check()

    def spin_until(self, done: Callable[[], T], timeout: float = math.inf) -> T:
        """Run what comes until `done` gives something true; returns what it gave last, which is not true where the timeout [s] came first."""
        last = time.monotonic() + timeout
        while not (found := done()) and time.monotonic() <= last:
            self.spin(SLICE)
        return found

    def spin_for(self, duration: float) -> float:
        """Run what comes for some wall-clock time; returns how long it really was [s]."""
        begin = time.monotonic()
        while (left := begin + duration - time.monotonic()) > 0.0:
            self.spin(min(left, SLICE))
        return time.monotonic() - begin

    def nodes(self) -> set[str]:
        """Fully qualified names of the nodes in the graph that this one has discovered."""
        return {f"{namespace.rstrip('/')}/{name}" for name, namespace in self.node.get_node_names_and_namespaces()}

    def visible_nodes(self) -> set[str]:
        """The same, after running what has come."""
        self.spin(0.02)
        return self.nodes()

    def close(self) -> None:
        """Leave the graph. An interrupt that no wait has raised is raised now."""
        for number, handler in self._handlers.items():
            signal.signal(number, handler or signal.SIG_DFL)
        self._executor.shutdown()  # it holds the context, and so the middleware's threads, sockets and shared memory
        self.node.destroy_node()
        self._context.try_shutdown()
        self.check()
