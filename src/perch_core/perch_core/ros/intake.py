"""Subscriptions that pass arriving messages to the inputs of a component."""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable
from functools import partial
from typing import Any

from perch_core.component import Input
from perch_core.errors import PerchError
from perch_core.ros import qos, topics
from perch_core.ros.component_node import ComponentNode
from perch_core.values import Serialized
from rclpy.clock import Clock, ClockType
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription

MATCH_PERIOD = 1.0  # of the check of the publishers' reliability for raw inputs [s]
TAKE_PERIOD = 0.02  # lazy inputs are read at least this often [s]
TAKE_MAX = 200      # messages of one lazy input that are read at a time: a flood leaves time for other events
SHARED_TOPICS = ("/tf", "/tf_static")  # channels with many publishers, inside this process and outside
OPEN_TOPICS = ("controller/command",)  # channels on which nodes outside of this process, as a ground station, are obeyed as well as a neighbour
OWN_KEPT = 200      # values of a neighbour on an open topic that are recognised where they return through the middleware


class Intake:
    """Subscriptions of one node. Messages of lazy inputs wait in the middleware until the next input that is not lazy.

    Attributes:
        private: resolved names of topics that a neighbour publishes; their values are passed in the process, others ignored,
            except on `OPEN_TOPICS`.
    """

    def __init__(self, node: ComponentNode) -> None:
        self._node, self._wiring = node, node.wiring
        self._lazy: list[tuple[Subscription, Callable[[bytes], None]]] = []
        self._raw_best_effort: list[tuple[Subscription, Input[Any], topics.Topic, Callable[[bytes], None]]] = []
        self.private: set[str] = set()

    def add(self, port: Input[Any]) -> None:
        """Subscribe to the topic of an input."""
        node, channel = self._node, port.channel(self._node.component)
        try:
            row = topics.topic(channel)
        except PerchError as error:
            node.get_logger().warning(f"{error}: not subscribed")
            return
        resolved = node.resolve_topic_name(channel)
        handler = partial(node.guarded, port.name, port.handler(node.component))
        own: deque[Any] = deque(maxlen=OWN_KEPT)
        if self._wiring.writer(resolved) is not None and channel not in SHARED_TOPICS:
            recorded = port.value is Serialized
            receive_local = self._local_receiver(port, row, channel, resolved, port.handler(node.component))
            self._wiring.add_reader(resolved, partial(node.guarded, port.name, receive_local), observer=recorded)
            if recorded or channel not in OPEN_TOPICS:
                self.private.add(resolved)
                return
            self._wiring.add_reader(resolved, own.append)
        if port.value is not Serialized:
            self._subscribe(port, row, _Reader(node, channel, row, handler, own), row.qos.subscribe)
            return
        receive = partial(self._receive_raw, row, channel, resolved, handler)
        subscription = self._subscribe(port, row, receive, qos.recording_profile(row.qos))
        if row.qos.subscribe.reliability is ReliabilityPolicy.BEST_EFFORT:
            if not self._raw_best_effort:
                node.create_timer(MATCH_PERIOD, lambda: self._wiring.enter(self._match_publishers), clock=Clock(clock_type=ClockType.STEADY_TIME))
            self._raw_best_effort.append((subscription, port, row, receive))

    def _subscribe(self, port: Input[Any], row: topics.Topic, receive: Callable[[bytes], None], profile: QoSProfile) -> Subscription:
        node, channel = self._node, port.channel(self._node.component)
        if not port.lazy:
            return node.create_subscription(row.message, channel, partial(self.enter, receive), profile, raw=True)
        if not self._lazy:
            node.create_timer(TAKE_PERIOD, lambda: self._wiring.enter(self.take_lazy), clock=Clock(clock_type=ClockType.STEADY_TIME))
        subscription = node.create_unwatched(row.message, channel, profile)
        self._lazy.append((subscription, receive))
        return subscription

    def _match_publishers(self) -> None:
        """Resubscribe as best effort to topics with a best-effort publisher, which a reliable subscription does not match."""
        for entry in tuple(self._raw_best_effort):
            subscription, port, row, receive = entry
            publishers = self._node.get_publishers_info_by_topic(subscription.topic_name)
            if any(one.qos_profile.reliability is ReliabilityPolicy.BEST_EFFORT for one in publishers):
                self._raw_best_effort.remove(entry)
                self._subscribe(port, row, receive, qos.recording_profile(row.qos, ReliabilityPolicy.BEST_EFFORT))
                self._lazy = [one for one in self._lazy if one[0] is not subscription]
                self._node.destroy_subscription(subscription)

    def take_lazy(self) -> None:
        """Process the messages of lazy inputs that wait in the middleware, up to `TAKE_MAX` of each."""
        for subscription, receive in self._lazy:
            with subscription.handle:
                for _ in range(TAKE_MAX):
                    taken = subscription.handle.take_message(subscription.msg_type, True)
                    if taken is None:
                        break
                    receive(taken[0])

    @staticmethod
    def _local_receiver(port: Input[Any], row: topics.Topic, channel: str, topic: str, handler: Callable[[Any], None]) -> Callable[[Any], None]:
        """Return the function that takes a neighbour's value; it raises an exception for a value that has no message."""
        if port.value is not Serialized:
            return handler
        return lambda value: handler(Serialized(topic, getattr(value, "stamp", 0), topics.encode(channel, value), row.message))

    def enter(self, work: Callable[[Any], None], argument: Any) -> None:
        """Process the event that woke the node, after the waiting messages of lazy inputs."""
        if self._lazy:
            self._wiring.enter(self.take_lazy)
        self._wiring.enter(work, argument)

    def _receive_raw(self, row: topics.Topic, channel: str, topic: str, handler: Callable[[Any], None], data: bytes) -> None:
        try:
            value = Serialized(topic, topics.stamp_of(row.message, data), data, row.message)
        except PerchError as error:
            self._node.log_refusal(channel, error)
            return
        handler(value)


class _Reader:
    """Reads the messages of a topic, at most as many per second as its row allows, without those values of neighbours that are in `own`."""

    def __init__(self, node: ComponentNode, channel: str, row: topics.Topic, handler: Callable[[Any], None], own: deque[Any]) -> None:
        self._node, self._channel, self._row, self._handler, self._own = node, channel, row, handler, own
        self._second = 0
        self._counts: Counter[Any] = Counter()  # messages of each kind in this second

    def __call__(self, data: bytes) -> None:
        """Pass the values of a serialised message to the handler."""
        try:
            if self._row.rate_max and self._row.kind is None:
                self._check_rate()
            value = self._row.read(data)
            if self._row.kind is not None:
                self._check_rate(self._row.kind(value))
        except Exception as error:
            self._node.log_refusal(self._channel, error)
            return
        for one in value if isinstance(value, list) else (value,):
            if one in self._own:
                self._own.remove(one)
            else:
                self._handler(one)

    def _check_rate(self, kind: Any = None) -> None:
        second = int(time.monotonic())
        if second != self._second:
            self._second = second
            self._counts.clear()
        self._counts[kind] += 1
        if self._counts[kind] > self._row.rate_max:
            raise PerchError(f"more than {self._row.rate_max} messages in a second")
