"""Publishes a message, once or at a rate."""

from __future__ import annotations

import argparse
import time

from ros_graph.commands import GraphError
from ros_graph.connection import visit
from ros_graph.interfaces import interface
from ros_graph.message_values import fill, parse
from ros_graph.qos_options import chosen_qos


def publish(arguments: argparse.Namespace) -> int:
    """`topic.py pub`"""
    message = fill(interface(arguments.type, "msg")(), parse(arguments.values, "message"))
    times = 1 if arguments.once else arguments.times
    with visit() as graph:
        topic = graph.absolute(arguments.topic)
        publisher = graph.node.create_publisher(type(message), topic, chosen_qos(arguments))
        listeners = arguments.wait_matching_subscriptions
        if listeners is None:
            listeners = 1 if times else 0
        matched = graph.spin_until(lambda: publisher.get_subscription_count() >= listeners, arguments.spin_time)
        if not matched:
            found = publisher.get_subscription_count()
            raise GraphError(f"topic {topic} has {found} subscribers, waited for {listeners}; -w 0 does not wait")
        sent = 0
        while times is None or sent < times:
            publisher.publish(message)
            sent += 1
            due = time.monotonic() + 1.0 / arguments.rate
            graph.spin_until(lambda: time.monotonic() >= due or sent == times)  # noqa: B023 (called in this turn)
        publisher.wait_for_all_acked()
    print(f"published {sent} message{'s' * (sent != 1)} on {topic}")
    return 0
