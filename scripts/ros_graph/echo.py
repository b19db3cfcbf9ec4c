"""Prints the messages of a topic as they come."""

from __future__ import annotations

import argparse
import sys
from typing import Any

from ros_graph.connection import visit
from ros_graph.message_text import TextOptions, pick, to_csv, to_yaml
from ros_graph.qos_options import chosen_qos
from ros_graph.topics import message_class


def echo(arguments: argparse.Namespace) -> int:
    """`topic.py echo`: 0 after the messages asked for, 1 where none came before the timeout."""
    options = TextOptions(
        arrays=not arguments.no_arr,
        strings=not arguments.no_str,
        length=None if arguments.full_length else arguments.truncate_length,
        flow=arguments.flow_style,
    )
    wanted = 1 if arguments.once else arguments.n
    shown = 0
    problem: list[Exception] = []

    def show(message: Any) -> None:
        nonlocal shown
        if problem or (wanted is not None and shown >= wanted):
            return
        try:
            value = pick(message, arguments.field) if arguments.field else message
            text = to_csv(value, options) if arguments.csv else to_yaml(value, options) + "---\n"
            sys.stdout.write(text)
            sys.stdout.flush()
        except Exception as error:  # raised again below: here it would end in the executor
            problem.append(error)
        shown += 1

    with visit() as graph:
        cls = message_class(graph, arguments.topic, arguments.type, arguments.spin_time)
        topic = graph.absolute(arguments.topic)
        publishers = graph.node.get_publishers_info_by_topic(topic)
        graph.node.create_subscription(cls, topic, show, chosen_qos(arguments, publishers))
        ended = graph.spin_until(lambda: bool(problem) or (wanted is not None and shown >= wanted), arguments.timeout)
    if problem:
        raise problem[0]
    return 0 if ended or shown else 1
