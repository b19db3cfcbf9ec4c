"""A temporary node in a running graph, with its own ROS context; its callbacks run only while its owner waits."""

from __future__ import annotations

import math
import signal
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

from perch_core.ros.joining import join
from rclpy.context import Context
from rclpy.experimental import EventsExecutor
from rclpy.node import Node

T = TypeVar("T")
SLICE = 0.05  # of a wait, after which an interrupt counts [s]


class GraphNode:
    """A temporary node. An interrupt ends its present or next wait; it is not raised in the signal handler, as the exception
    would then occur in rclpy's C++ code.

    Attributes:
        node: for publishers, subscriptions and clients.
    """

    def __init__(self, name: str, arguments: Sequence[str] = (), interrupts: Sequence[signal.Signals] = (signal.SIGINT,)) -> None:
        """
        Args:
            name: of the node.
            arguments: ROS arguments.
            interrupts: signals that raise KeyboardInterrupt in the wait; only if created in the main thread.
        """
        self._context = Context()
        join([], self._context)
        self.node = Node(name, context=self._context, cli_args=["--ros-args", *arguments], start_parameter_services=False, enable_rosout=False)
        self._executor = EventsExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._interrupted = False
        main = threading.current_thread() is threading.main_thread()
        self._handlers: dict[signal.Signals, Any] = {one: signal.signal(one, self._interrupt) for one in interrupts if main}

    def _interrupt(self, *_: object) -> None:
        self._interrupted = True

    def check(self) -> None:
        """Raise KeyboardInterrupt if an interrupt was received."""
        if self._interrupted:
            self._interrupted = False
            raise KeyboardInterrupt

    def spin(self, timeout: float) -> None:
        """Execute callbacks that are due, or become due within the time-out [s].

        Raises:
            KeyboardInterrupt: an interrupt was received.
        """
        self._executor.spin_once(timeout_sec=timeout)
        self.check()

    def spin_until(self, done: Callable[[], T], timeout: float = math.inf) -> T:
        """Execute callbacks until `done` returns a true value or the time-out [s] expires; return the last value of `done`."""
        last = time.monotonic() + timeout
        while not (found := done()) and time.monotonic() <= last:
            self.spin(SLICE)
        return found

    def listen(self, duration: float) -> float:
        """Execute callbacks for a wall-clock time; return its actual duration [s]."""
        begin = time.monotonic()
        while (left := begin + duration - time.monotonic()) > 0.0:
            self.spin(min(left, SLICE))
        return time.monotonic() - begin

    def nodes(self) -> set[str]:
        """Return the fully qualified names of the nodes discovered so far."""
        return {f"{namespace.rstrip('/')}/{name}" for name, namespace in self.node.get_node_names_and_namespaces()}

    def visible_nodes(self) -> set[str]:
        """Return the same after executing pending callbacks."""
        self.spin(0.02)
        return self.nodes()

    def close(self) -> None:
        """Leave the graph; raise KeyboardInterrupt for an interrupt that is still pending."""
        for number, handler in self._handlers.items():
            signal.signal(number, handler or signal.SIG_DFL)
        self._executor.shutdown()  # it holds the context, and so the middleware's threads, sockets and shared memory
        self.node.destroy_node()
        self._context.try_shutdown()
        self.check()
