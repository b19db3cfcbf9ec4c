"""Publishes on every topic that a flight uses, latched, good messages and nonsense in turn, and wall-clock time on its clock.

Started by test_flight_surface.py; SIGTERM ends it.
"""

from __future__ import annotations

import rclpy
from nodes.good import messages
from fuzzing.spoiled import plain_ways, spoilt
from perch_core.ros import topics
from perch_core.ros.node import StopSignal
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.signals import SignalHandlerOptions
from rosgraph_msgs.msg import Clock

RATE = 5.0  # rounds of one message on each topic [Hz]
NEXT = 4_000_000  # [ns] ahead of the clock: nobody else has said anything of this stamp yet
FOREIGN = 1_795_000_000  # of its clock, which shows wall-clock time [s]


class Stranger(Node):
    """Knows nothing of the lockstep."""

    def __init__(self) -> None:
        super().__init__("stranger")
        self._stamp, self._rounds = 0, 0
        self._extra = {row.channel.replace("*", "front"): row for row in topics.TOPICS if not row.channel.startswith("/")}
        latched = QoSProfile(depth=5, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._wall_clock = self.create_publisher(Clock, "/clock", latched)
        names = {**{channel: row.message for channel, row in self._extra.items()}, **{t: type(m) for t, m in messages(0).items()}}
        self._publishers = {topic: self.create_publisher(message, topic, latched) for topic, message in names.items()}
        self.create_subscription(Clock, "/clock", self._hear, topics.topic("/clock").qos.subscribe)
        self.create_timer(1.0 / RATE, self._send)

    def _hear(self, message: Clock) -> None:
        if message.clock.sec != FOREIGN:
            self._stamp = message.clock.sec * 10**9 + message.clock.nanosec

    def _send(self) -> None:
        good, clock = messages(self._stamp + NEXT), Clock()
        clock.clock.sec = FOREIGN
        self._wall_clock.publish(clock)
        for topic, publisher in self._publishers.items():
            message = good.get(topic) or self._extra[topic].message()
            if self._rounds % 2 and topic in good:
                wrong = list(plain_ways(message).values())
                message = spoilt(message, [wrong[self._rounds // 2 % len(wrong)]])
            publisher.publish(message)
        self._rounds += 1


stop = StopSignal()
rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
node, executor = Stranger(), SingleThreadedExecutor()
executor.add_node(node)
print("up", flush=True)
stop.defer = True
while not stop:
    executor.spin_once(timeout_sec=0.1)
