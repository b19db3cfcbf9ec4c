"""Sub-commands of `topic.py`: describe topics; print, count and publish messages."""

from __future__ import annotations

import argparse
import math
import statistics
import sys
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from ros_graph.commands import GraphError, NoAnswerError
from ros_graph.connection import GraphConnection
from ros_graph.messages import fill, interface, parse, pick, to_yaml

REPORT_PERIOD = 1.0  # of `hz` [s]


def show_info(graph: GraphConnection, arguments: argparse.Namespace) -> int:
    """Run `topic.py info`."""
    topic = graph.absolute(arguments.topic)
    topic_types(graph, topic, arguments.spin_time)  # there are some
    sides = graph.settle(lambda: _sides(graph, topic), arguments.spin_time)
    print(f"Type: {', '.join(topic_types(graph, topic, arguments.spin_time))}\n")
    for side, endpoints in sides.items():
        print(f"{side} count: {len(endpoints)}")
        if arguments.verbose and endpoints:
            print("\n" + "\n".join(endpoints) + "\n")
    return 0


def echo(graph: GraphConnection, arguments: argparse.Namespace) -> int:
    """Run `topic.py echo`."""
    limit = 1 if arguments.once else arguments.n or math.inf
    shown = 0
    problem: list[Exception] = []

    def show(message: Any) -> None:
        nonlocal shown
        if problem or shown >= limit:
            return
        try:
            value = pick(message, arguments.field) if arguments.field else message
            sys.stdout.write(to_yaml(value, not arguments.no_arr) + "---\n")
            sys.stdout.flush()
        except Exception as error:  # raised again below: here it would end in the executor
            problem.append(error)
        shown += 1

    _subscribe(graph, arguments, show)
    graph.spin_until(lambda: problem or shown >= limit)
    if problem:
        raise problem[0]
    return 0


def measure_rate(graph: GraphConnection, arguments: argparse.Namespace) -> int:
    """Run `topic.py hz`: print the rate every second; with `-n`, end after that number of messages."""
    arrivals: deque[float] = deque(maxlen=max(arguments.window, 2))
    limit, count, reported = arguments.n or math.inf, 0, 0

    def arrived(_: bytes) -> None:
        nonlocal count
        count += 1
        arrivals.append(time.monotonic())

    _subscribe(graph, arguments, arrived, raw=True)  # counting does not need the content of an image
    while count < limit:
        finished = graph.spin_until(lambda: count >= limit, REPORT_PERIOD)
        print(rate_summary(list(arrivals)) if count > reported or finished else "no new messages", flush=True)
        reported = count
    return 0


def rate_summary(arrivals: Sequence[float]) -> str:
    """Describe rate and intervals in the format of `ros2 topic hz`.

    Args:
        arrivals: times of arrival [s], in order.
    """
    if len(arrivals) < 2:
        return "average rate: one message so far"
    intervals = [later - earlier for earlier, later in zip(arrivals, arrivals[1:])]
    mean = sum(intervals) / len(intervals)
    rate = 1.0 / mean if mean > 0.0 else float("inf")
    return (
        f"average rate: {rate:.3f}\n\tmin: {min(intervals):.3f}s max: {max(intervals):.3f}s "
        f"std dev: {statistics.pstdev(intervals):.5f}s window: {len(arrivals)}"
    )


def publish(graph: GraphConnection, arguments: argparse.Namespace) -> int:
    """Run `topic.py pub`."""
    message = fill(interface(arguments.type, "msg")(), parse(arguments.values, "message"))
    topic = graph.absolute(arguments.topic)
    publisher = graph.node.create_publisher(type(message), topic, QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL))
    if arguments.once and not graph.spin_until(lambda: publisher.get_subscription_count() > 0, arguments.spin_time):
        raise GraphError(f"topic {topic} has no subscribers of this type within {arguments.spin_time:g} s; 'topic.py info {topic}' shows its type")
    publisher.publish(message)
    due = time.monotonic()
    while not arguments.once:
        due = max(due + 1.0 / arguments.rate, time.monotonic())
        graph.spin_for(due - time.monotonic())
        graph.check()  # does not spin at a rate that is too high
        publisher.publish(message)
    if not publisher.wait_for_all_acked(Duration(seconds=10)):
        raise NoAnswerError(f"topic {topic}: a subscriber has not acknowledged the message within 10 s")
    print(f"published one message on {topic}")
    return 0


def topic_types(graph: GraphConnection, topic: str, timeout: float) -> Sequence[str]:
    """Return the names of a topic's types, as soon as the topic exists in the graph.

    Raises:
        GraphError: the topic does not appear in time.
    """
    types = graph.spin_until(lambda: dict(graph.node.get_topic_names_and_types()).get(topic), timeout)
    if not types:
        domain = graph.node.context.get_domain_id()
        raise GraphError(f"topic {topic} does not exist in ROS domain {domain}; 'topic.py list' shows what does")
    return types


def _subscribe(graph: GraphConnection, arguments: argparse.Namespace, callback: Callable[[Any], None], raw: bool = False) -> None:
    """Subscribe to the topic of the command line with QoS compatible with its publishers; its type is given or from the graph."""
    topic = graph.absolute(arguments.topic)
    types = [arguments.type] if arguments.type else topic_types(graph, topic, arguments.spin_time)
    if len(types) > 1:
        raise GraphError(f"topic {topic} has several types: {', '.join(types)}; name one after the topic")
    cls = interface(types[0], "msg")
    publishers = graph.spin_until(lambda: graph.node.get_publishers_info_by_topic(topic), arguments.spin_time)
    profiles = [endpoint.qos_profile for endpoint in publishers]
    profile = QoSProfile(depth=10)
    if any(p.reliability == ReliabilityPolicy.BEST_EFFORT for p in profiles):
        profile.reliability = ReliabilityPolicy.BEST_EFFORT
    if profiles and all(p.durability == DurabilityPolicy.TRANSIENT_LOCAL for p in profiles):
        profile.durability = DurabilityPolicy.TRANSIENT_LOCAL
    graph.node.create_subscription(cls, topic, callback, profile, raw=raw)


def _sides(graph: GraphConnection, topic: str) -> dict[str, list[str]]:
    return {
        "Publisher": [_describe(e) for e in graph.node.get_publishers_info_by_topic(topic)],
        "Subscription": [_describe(e) for e in graph.node.get_subscriptions_info_by_topic(topic)],
    }


def _describe(endpoint) -> str:
    qos = endpoint.qos_profile
    node = f"{endpoint.node_namespace.rstrip('/')}/{endpoint.node_name}"
    return f"Node: {node}  reliability: {qos.reliability.name}  durability: {qos.durability.name}"
