"""Relay that forwards messages and disturbs them on request: the node publishes on `direct/<channel>`, subscribers use the relay.

    python3 -m perch_eval.graph_faults.relay_node odometry estimator/status --ros-args

A message on `relay/fault` (std_msgs/String) sets the disturbance: delay, drop, duplicate or reorder; others forward unchanged.
"""

from __future__ import annotations

import random
import sys
import time
from collections import deque
from functools import partial
from typing import Any

import rclpy
from rclpy.clock import Clock, ClockType
from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from rclpy.publisher import Publisher
from std_msgs.msg import String

from perch_core.ros import topics
from perch_core.ros.joining import join
from perch_core.ros.node import StopSignal, spin_until_stopped

DIRECT = "direct"
DELAY = 0.2    # [s]
PERIOD = 0.002  # between looks for what is due [s]


class Disturbance:
    """Disturbance of the messages of one channel."""

    def __init__(self, seed: int = 1) -> None:
        self.fault = ""
        self._rng = random.Random(seed)
        self._kept: list[Any] = []
        self._late: deque[tuple[float, Any]] = deque()

    def passed(self, message: Any, now: float) -> list[Any]:
        """Return the messages to forward when a message arrives, at a time of the monotonic clock [s]."""
        if self.fault == "delay":
            self._late.append((now + DELAY, message))
            return []
        if self.fault == "drop":
            return [] if self._rng.random() < 0.5 else [message]
        if self.fault == "duplicate":
            return [message, message]
        if self.fault == "reorder":
            self._kept.append(message)
            if len(self._kept) < 2:
                return []
            found, self._kept = self._kept[::-1], []
            return found
        return [message]

    def due(self, now: float) -> list[Any]:
        """Return the delayed messages that are due at a time of the monotonic clock [s]."""
        found = []
        while self._late and self._late[0][0] <= now:
            found.append(self._late.popleft()[1])
        return found


class RelayNode(Node):
    """Node that relays channels, with one disturbance for each."""

    def __init__(self, channels: list[str]) -> None:
        super().__init__("relay")
        self._ways: list[tuple[Disturbance, Publisher]] = []
        for k, channel in enumerate(channels):
            row = topics.topic(channel)
            way = Disturbance(k), self.create_publisher(row.message, channel, row.qos.publish)
            self._ways.append(way)
            self.create_subscription(row.message, f"{DIRECT}/{channel}", partial(self._take, *way), row.qos.subscribe, raw=True)
        self.create_subscription(String, "relay/fault", self._change, topics.topic("trajectory").qos.subscribe)
        self._timer = self.create_timer(PERIOD, self._look, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._timer.cancel()

    def _take(self, disturbance: Disturbance, publisher: Publisher, message: bytes) -> None:
        for one in disturbance.passed(message, time.monotonic()):
            publisher.publish(one)

    def _look(self) -> None:
        for disturbance, publisher in self._ways:
            for one in disturbance.due(time.monotonic()):
                publisher.publish(one)

    def _change(self, message: String) -> None:
        for disturbance, _ in self._ways:
            disturbance.fault = message.data
        if message.data == "delay":
            self._timer.reset()


def main() -> None:
    """Relay the channels of the command line until SIGINT or SIGTERM."""
    end = sys.argv.index("--ros-args") if "--ros-args" in sys.argv else len(sys.argv)
    stop = StopSignal()
    join(sys.argv)
    node, executor = RelayNode(sys.argv[1:end]), EventsExecutor()
    executor.add_node(node)
    stop.patient = True
    spin_until_stopped(executor, stop)
    node.destroy_node()
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
