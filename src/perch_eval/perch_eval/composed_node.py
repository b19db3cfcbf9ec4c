"""Several nodes in one process, on one executor: the same classes.

    composed PLAN.json

The plan is a list of `{"name": ..., "module": ..., "arguments": [ROS arguments]}`; `start_stack.py --composed` writes it.
"""

from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path
from typing import Any

import rclpy
from perch_core.errors import PerchError
from perch_core.ros.composition import composition
from perch_core.ros.node import StopSignal, close_nodes, settle, spin_until_stopped
from perch_core.ros.priority import priority
from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions


def create_nodes(plan: list[dict[str, Any]]) -> list[Node]:
    """Create every node of a plan, each with its own arguments; all or none.

    Raises:
        PerchError: a node refuses its parameters.
    """
    nodes: list[Node] = []
    try:
        for entry in plan:
            create = importlib.import_module(entry["module"]).create
            nodes.append(create(cli_args=entry["arguments"], use_global_arguments=False))
    except BaseException:
        close_nodes(nodes)
        raise
    return nodes


def main() -> None:
    """Run the nodes of a plan until SIGINT or SIGTERM; exit code 2 where one refuses its parameters."""
    if len(sys.argv) != 2 or sys.argv[1].startswith("-"):
        print("usage: composed PLAN.json (start_stack.py --composed writes one)", file=sys.stderr)
        sys.exit(2)
    try:
        plan = json.loads(Path(sys.argv[1]).read_text())
    except (OSError, ValueError) as error:
        print(f"error: {sys.argv[1]}: {error}", file=sys.stderr)
        sys.exit(2)
    stop = StopSignal()
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    nodes: list[Node] = []
    try:
        with composition.creating():
            nodes = create_nodes(plan)
        priority.nodes = len(nodes)
        settle()
        executor = EventsExecutor()
        for node in nodes:
            executor.add_node(node)
        composition.connect(executor)
        spin_until_stopped(executor, stop)
    except (PerchError, rclpy.exceptions.InvalidParameterValueException) as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    finally:
        close_nodes(nodes)
        rclpy.try_shutdown()
    sys.exit(0)


if __name__ == "__main__":
    main()
