"""Measures the rate of a topic."""

from __future__ import annotations

import argparse
import statistics
import time
from collections import deque
from collections.abc import Sequence

from ros_graph.connection import visit
from ros_graph.topics import message_class, qos_of

_REPORT_PERIOD_S = 1.0


def measure_rate(arguments: argparse.Namespace) -> int:
    """`topic.py hz`: prints the rate every second; with `-n`, ends after so many messages."""
    arrivals: deque[float] = deque(maxlen=arguments.window)
    count = 0

    def arrived(_: bytes) -> None:
        nonlocal count
        count += 1
        arrivals.append(time.monotonic())

    with visit() as graph:
        cls = message_class(graph, arguments.topic, arguments.type, arguments.spin_time)
        topic = graph.absolute(arguments.topic)
        # raw: counting does not need the content of an image
        graph.node.create_subscription(cls, topic, arrived, qos_of(graph, topic), raw=True)
        reported = 0
        while not (arguments.n is not None and count >= arguments.n):
            finished = graph.spin_until(
                lambda: arguments.n is not None and count >= arguments.n, timeout=_REPORT_PERIOD_S
            )
            if count > reported or finished:
                print(summary(list(arrivals)), flush=True)
            else:
                print("no new messages", flush=True)
            reported = count
    return 0


def summary(arrivals: Sequence[float]) -> str:
    """Rate and intervals in the words of `ros2 topic hz`.

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
