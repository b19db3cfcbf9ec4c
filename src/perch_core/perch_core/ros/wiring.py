"""Communication between the nodes of one process, and publication of their messages to other processes.

rclpy, unlike rclcpp, has no intra-process communication: a message to a neighbour would go through the middleware, which costs 20
to 60 us for each reader. Components that share a process receive values directly, in the order of their emission, each handler
after the previous one. Messages leave the process when all values between neighbours have been handled, so that no neighbour
waits for the middleware.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from rclpy.publisher import Publisher

UNNAMED = "_NODE_NAME_UNKNOWN_"  # of rcl, for a publisher that was discovered before its node
LOOK = 0.1      # between two looks at who listens: asking the middleware takes 5 us [s]
BUNDLE = 0.008  # what may wait leaves this often [s]

Receive = Callable[[Any], None]


class Publication:
    """A topic that leaves the process if it has subscribers."""

    def __init__(self, publisher: Publisher, to_message: Callable[[Any], Any], always: bool, frequent: bool = False,
                 observed: bool = False) -> None:
        """
        Args:
            publisher: publisher of the topic.
            to_message: value to message, or to a serialised one.
            always: publish also without subscribers: a latched topic keeps its last message for late subscribers.
            frequent: emitted with every IMU sample; its message may be delayed if a neighbour takes the value.
            observed: for observers only; no component in flight waits for it.
        """
        self._publisher, self._to_message, self._always = publisher, to_message, always
        self.frequent, self.observed = frequent, observed
        self._heard, self._looked = False, 0.0

    def heard(self) -> bool:
        """Return whether the topic has subscribers, or is published without them."""
        if self._always:
            return True
        now = time.monotonic()
        if now - self._looked > LOOK:
            self._heard, self._looked = self._publisher.get_subscription_count() > 0, now
        return self._heard

    def send(self, value: Any) -> None:
        """Publish a value if `heard`."""
        if self.heard():
            self._publisher.publish(self._to_message(value))


class Wiring:
    """Connections among the nodes of one process. A single node has a `Wiring` of its own.

    Attributes:
        participants: nodes that take part in a lockstep, by name, for a vehicle in this process.
        schedule_here: whether that vehicle is in this process.
        paced: the process has deadlines and handles events every few milliseconds; messages without urgency leave in bundles.
        progress: notifies that vehicle that something for which it may be waiting has arrived.
    """

    def __init__(self) -> None:
        self._neighbours: dict[str, list[Receive]] = {}
        self._writers: dict[str, str] = {}  # topic -> node of this process that publishes it
        self._queue: deque[tuple[Callable[..., None], tuple[Any, ...]]] = deque()
        self._leaving: deque[tuple[Publication, Any]] = deque()
        self._working, self._urgent = False, False
        self._left = 0.0  # when something left the process last, monotonic clock [s]
        self._executor: Any = None
        self._early: deque[tuple[Any, ...]] = deque()  # what threads have done before there was an executor
        self.participants: dict[str, Any] = {}  # of a lockstep, in this process
        self.schedule_here = False              # a lockstep's vehicle is in this process
        self.paced = False
        self.progress: Callable[[], None] = lambda: None

    # -- connecting --------------------------------------------------------------------------------------------------

    def writes(self, topic: str, node: str) -> None:
        """Register the node of this process that publishes a topic."""
        self._writers[topic] = node

    def writer(self, topic: str) -> str | None:
        """Return the node of this process that publishes a topic, or None."""
        return self._writers.get(topic)

    def add_reader(self, topic: str, receive: Receive) -> None:
        """Pass every value of a topic that is published in this process to `receive`."""
        self._neighbours.setdefault(topic, []).append(receive)

    def read_here(self, topic: str) -> bool:
        """Return whether a node of this process receives a topic directly."""
        return topic in self._neighbours

    # -- working -----------------------------------------------------------------------------------------------------

    def emit(self, topic: str, publication: Publication, value: Any) -> None:
        """Pass a value of a node of this process to its neighbours, and queue it for publication."""
        neighbours = self._neighbours.get(topic, ())
        for receive in neighbours:
            self._queue.append((receive, (value,)))
        if not (publication.observed or (publication.frequent and neighbours)):
            self._urgent = True
        self._leaving.append((publication, value))
        if not self._working:
            self._drain()

    def enter(self, work: Callable[..., None], *arguments: Any) -> None:
        """Process an event and everything that follows from it in this process; then publish."""
        self._queue.append((work, arguments))
        if not self._working:
            self._drain()

    def _drain(self) -> None:
        queue, leaving = self._queue, self._leaving
        self._working = True
        try:
            while queue:
                work, arguments = queue.popleft()
                work(*arguments)
            if leaving and (self._urgent or not self.paced or time.monotonic() - self._left > BUNDLE):
                while leaving:
                    publication, value = leaving.popleft()
                    publication.send(value)
                self._left, self._urgent = time.monotonic(), False
        finally:
            self._working = False

    def run_on(self, executor: Any) -> None:
        """Set the executor that runs the nodes' callbacks, and give it the work that threads have queued before."""
        self._executor = executor
        while self._early:
            executor.create_task(self.enter, *self._early.popleft())

    def from_thread(self, work: Callable[..., None], *arguments: Any) -> None:
        """Schedule work on the executor's thread; any thread may call this. Work must not raise: that would end the process."""
        if self._executor is None:
            self._early.append((work, *arguments))
        else:
            self._executor.create_task(self.enter, work, *arguments)


def foreign_writers(node: Node, topic: str, known: set[str]) -> list[str]:
    """Return the fully qualified names, as far as discovered, of nodes that publish a topic and are not in `known`."""
    found = {f"{info.node_namespace.rstrip('/')}/{info.node_name}" for info in node.get_publishers_info_by_topic(topic)
             if info.node_name != UNNAMED}
    return sorted(name for name in found if name not in known)
