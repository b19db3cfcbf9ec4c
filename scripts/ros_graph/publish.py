"""Publishes a message, once or at a rate."""

from __future__ import annotations

import argparse
import time

from ros_graph.commands import GraphError
from ros_graph.connection import visit
from ros_graph.interfaces import interface
from ros_graph.message_values import fill, parse


def publish(arguments: argparse.Namespace) -> int:
    """`topic.py pub`"""
    message = fill(interface(arguments.type, "msg")(), parse(arguments.values, "message"))
    with visit() as graph:
        topic = graph.absolute(arguments.topic)
        publisher = graph.node.create_publisher(type(message), topic, 10)
        if arguments.once and not graph.spin_until(lambda: publisher.get_subscription_count() > 0, arguments.spin_time):
            raise GraphError(f"topic {topic} has no subscribers")
        publisher.publish(message)
        while not arguments.once:
            due = time.monotonic() + 1.0 / arguments.rate
            graph.spin_until(lambda: time.monotonic() >= due)  # noqa: B023 (called in this turn)
            publisher.publish(message)
        publisher.wait_for_all_acked()
    print(f"published one message on {topic}")
    return 0
