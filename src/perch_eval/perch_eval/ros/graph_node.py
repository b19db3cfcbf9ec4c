"""A visit to a running graph: a node in a ROS context of its own."""

from __future__ import annotations

from rclpy.context import Context
from rclpy.experimental import EventsExecutor
from rclpy.node import Node

from perch_core.ros.joining import join
from perch_eval.nodes import in_namespace


class GraphNode:
    """A node whose callbacks run while its owner spins.

    Attributes:
        node: for publishers, subscriptions and clients.
    """

    def __init__(self, name: str, namespace: str = "") -> None:
        """
        Args:
            name: of the node.
            namespace: of the vehicle's nodes, as in `/quad1`.
        """
        self._context = Context()
        join(context=self._context)
        self.node = Node(name, context=self._context, cli_args=["--ros-args", *in_namespace(namespace)], start_parameter_services=False)
        self._executor = EventsExecutor(context=self._context)
        self._executor.add_node(self.node)

    def spin(self, timeout: float) -> None:
        """Run what has come, or comes in time [s]."""
        self._executor.spin_once(timeout_sec=timeout)

    def close(self) -> None:
        """Leave the graph."""
        self._executor.shutdown()  # it holds the context, and so the middleware's threads, sockets and shared memory
        self.node.destroy_node()
        self._context.try_shutdown()
