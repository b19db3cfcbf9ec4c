"""A short-lived connection to the ROS graph."""

from __future__ import annotations

import argparse
import signal
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, closing
from typing import Any, TypeVar

from rclpy.action import get_action_names_and_types
from rclpy.node import Node
from rclpy.task import Future

from perch_eval.ros.graph_node import GraphNode
from ros_graph.commands import GraphError, NoAnswerError, is_absolute_name

T = TypeVar("T")
_SETTLED_S = 1.0
"""Discovery counts as finished when nothing in the whole graph has changed for this time [s]."""


class GraphConnection(GraphNode):
    """A hidden node, with methods to wait for answers."""

    def __init__(self) -> None:
        super().__init__(f"_perch_{time.time_ns() % 1_000_000_000}", interrupts=(signal.SIGINT, signal.SIGTERM))

    def answer(self, future: Future, what: str, timeout: float = 10.0) -> Any:
        """Wait for the result of a future.

        Raises:
            NoAnswerError: no answer in time.
        """
        if not self.spin_until(future.done, timeout):
            raise NoAnswerError(f"{what}: no answer within {timeout:g} s")
        return future.result()

    def settle(self, observe: Callable[[], T], timeout: float) -> T:
        """Return an observation of the graph once the whole graph has settled, at the latest after `timeout` [s].

        What is observed may lack endpoints while it does not change: on a busy machine nodes are discovered one by one.
        """
        def everything() -> tuple[T, object, object]:
            return observe(), self.nodes(), self.node.get_topic_names_and_types(no_demangle=True)

        last, since = everything(), time.monotonic()
        end = since + timeout

        def settled() -> bool:
            nonlocal last, since
            now = everything()
            if now != last:
                last, since = now, time.monotonic()
            return time.monotonic() - since > _SETTLED_S or time.monotonic() > end

        self.spin_until(settled)
        return last[0]

    def absolute(self, name: str) -> str:
        """Return a name as an absolute one.

        Raises:
            GraphError: it is none of ROS.
        """
        absolute = name if name.startswith("/") else f"/{name}"
        if not is_absolute_name(absolute):
            raise GraphError(f"name {name!r}: expected words of letters, digits and '_' with '/' between them, as in /quad1/odometry")
        return absolute


def connect() -> AbstractContextManager[GraphConnection]:
    """Join the graph with a hidden node, and leave it again."""
    return closing(GraphConnection())


def hidden(name: str) -> bool:
    """Return whether a name is hidden in lists: a part of it begins with an underscore."""
    return any(part.startswith("_") for part in name.split("/"))


def list_names(graph: GraphConnection, arguments: argparse.Namespace) -> int:
    """Run `list`: print the names of a kind that are not hidden, with their types if requested (`-t`)."""
    observe = {"topics": Node.get_topic_names_and_types, "services": Node.get_service_names_and_types,
               "actions": get_action_names_and_types}[arguments.kind]
    found = graph.settle(lambda: observe(graph.node), arguments.spin_time)
    for name, types in sorted(found):
        if not hidden(name):
            print(f"{name} [{', '.join(types)}]" if arguments.show_types else name)
    return 0
