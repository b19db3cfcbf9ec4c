"""Prints the messages of a topic as they come."""

from __future__ import annotations

import argparse
import sys
from typing import Any

from ros_graph.connection import visit
from ros_graph.message_text import pick, to_yaml
from ros_graph.topics import message_class, qos_of


def echo(arguments: argparse.Namespace) -> int:
    """`topic.py echo`"""
    wanted = 1 if arguments.once else arguments.n
    shown = 0
    problem: list[Exception] = []

    def show(message: Any) -> None:
        nonlocal shown
        if problem or (wanted is not None and shown >= wanted):
            return
        try:
            value = pick(message, arguments.field) if arguments.field else message
            sys.stdout.write(to_yaml(value, not arguments.no_arr) + "---\n")
            sys.stdout.flush()
        except Exception as error:  # raised again below: here it would end in the executor
            problem.append(error)
        shown += 1

    with visit() as graph:
        cls = message_class(graph, arguments.topic, arguments.type, arguments.spin_time)
        topic = graph.absolute(arguments.topic)
        graph.node.create_subscription(cls, topic, show, qos_of(graph, topic))
        graph.spin_until(lambda: bool(problem) or (wanted is not None and shown >= wanted))
    if problem:
        raise problem[0]
    return 0
