"""Sub-commands that send requests and goals."""

from __future__ import annotations

import argparse
import sys

from action_msgs.msg import GoalStatus
from rclpy.action import ActionClient
from rclpy.action.client import ClientGoalHandle

from ros_graph.commands import GraphError
from ros_graph.connection import GraphConnection
from ros_graph.messages import fill, interface, parse, to_yaml

_STATUS = {
    GoalStatus.STATUS_SUCCEEDED: "SUCCEEDED",
    GoalStatus.STATUS_CANCELED: "CANCELED",
    GoalStatus.STATUS_ABORTED: "ABORTED",
}


def call_service(graph: GraphConnection, arguments: argparse.Namespace) -> int:
    """Run `service.py call`: print the response; return 1 if it has `success: false`, otherwise 0."""
    cls = interface(arguments.type, "srv")
    request = fill(cls.Request(), parse(arguments.values, "request"))
    service = graph.absolute(arguments.service)
    client = graph.node.create_client(cls, service)
    if not graph.spin_until(client.service_is_ready, arguments.spin_time):
        raise GraphError(f"service {service} does not exist with type {arguments.type}; 'service.py list -t' shows all")
    response = graph.answer(client.call_async(request), service, timeout=30.0)
    sys.stdout.write(to_yaml(response))
    return 0 if getattr(response, "success", True) else 1


def send_goal(graph: GraphConnection, arguments: argparse.Namespace) -> int:
    """Run `action.py send_goal`: return 0 if the goal succeeds, otherwise 1. Ctrl-C cancels the goal, and is raised again."""
    cls = interface(arguments.type, "action")
    goal = fill(cls.Goal(), parse(arguments.values, "goal"))
    action = graph.absolute(arguments.action)
    client = ActionClient(graph.node, cls, action)
    if not graph.spin_until(client.server_is_ready, arguments.spin_time):
        raise GraphError(f"action {action} does not exist with type {arguments.type}; 'action.py list -t' shows all")

    def show(message) -> None:
        sys.stdout.write(f"feedback:\n{_indented(to_yaml(message.feedback))}")
        sys.stdout.flush()

    sent = client.send_goal_async(goal, feedback_callback=show if arguments.feedback else None)
    try:
        handle = graph.answer(sent, action)
    except KeyboardInterrupt:  # the goal may have been accepted all the same
        handle = graph.answer(sent, action)
        if handle.accepted:
            _cancel(graph, handle)
        raise
    if not handle.accepted:
        print("goal rejected")
        return 1
    print("goal accepted", flush=True)
    result = handle.get_result_async()
    try:
        graph.spin_until(result.done)
    except KeyboardInterrupt:
        _cancel(graph, handle)
        _print_outcome(graph.answer(result, "cancelled goal", timeout=30.0))
        raise
    return 0 if _print_outcome(result.result()) == GoalStatus.STATUS_SUCCEEDED else 1


def _cancel(graph: GraphConnection, handle: ClientGoalHandle) -> None:
    print("cancelling the goal", file=sys.stderr)
    graph.answer(handle.cancel_goal_async(), "cancel")


def _print_outcome(outcome) -> int:
    """Print a goal's result and status; return the status."""
    status = _STATUS.get(outcome.status, f"UNKNOWN ({outcome.status})")
    print(f"result:\n{_indented(to_yaml(outcome.result))}goal finished: {status}", flush=True)
    return outcome.status


def _indented(text: str) -> str:
    return "".join(f"  {line}\n" for line in text.splitlines())
