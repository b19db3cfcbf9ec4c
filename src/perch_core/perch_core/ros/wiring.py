"""What the nodes of one process say to each other, and when it leaves the process.

rclcpp has intra-process communication, rclpy has not: there a message to a neighbour goes through the middleware, which costs 20 to
60 us for each reader. Components that share a process get values directly. They are handed on in the order of their emission, each
handler after the one before; what leaves the process does so when the neighbours have no more to say to each other, so that nobody
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
    """A topic that leaves the process, where somebody listens."""

    def __init__(self, publisher: Publisher, to_message: Callable[[Any], Any], always: bool, frequent: bool = False,
                 observed: bool = False) -> None:
        """
        Args:
            publisher: of the topic.
            to_message: value to message, or to a serialised one.
            always: also where nobody listens: a latched topic keeps its last message for who comes late.
            frequent: a message comes with every IMU sample; it may wait where a neighbour takes it.
            observed: nobody who flies waits for it.
        """
        self._publisher, self._to_message, self._always = publisher, to_message, always
        self.frequent, self.observed = frequent, observed
        self._heard, self._looked = False, 0.0

    def heard(self) -> bool:
        """Whether anybody outside this process listens, or will want to know."""
        if self._always:
            return True
        now = time.monotonic()
        if now - self._looked > LOOK:
            self._heard, self._looked = self._publisher.get_subscription_count() > 0, now
        return self._heard

    def send(self, value: Any) -> None:
        """Publish a value, where somebody listens."""
        if self.heard():
            self._publisher.publish(self._to_message(value))


class Wiring:
    """The neighbours of one process. A node that is alone in its process has one of its own.

    Attributes:
        participants: nodes that take part in a lockstep, by name, for a vehicle in this process.
        schedule_here: that vehicle is there.
        paced: the process has deadlines and always goes on within milliseconds: what nobody waits for leaves in bundles.
        progress: tells it that something which it may have waited for has come.
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
        """A node of this process publishes a topic."""
        self._writers[topic] = node

    def writer(self, topic: str) -> str | None:
        """The node of this process that publishes a topic."""
        return self._writers.get(topic)

    def add_reader(self, topic: str, receive: Receive) -> None:
        """Hand every value of a topic that is published in this process to `receive`."""
        self._neighbours.setdefault(topic, []).append(receive)

    def read_here(self, topic: str) -> bool:
        """Whether a node of this process takes a topic."""
        return topic in self._neighbours

    # -- working -----------------------------------------------------------------------------------------------------

    def emit(self, topic: str, publication: Publication, value: Any) -> None:
        """A node of this process publishes a value."""
        neighbours = self._neighbours.get(topic, ())
        for receive in neighbours:
            self._queue.append((receive, (value,)))
        if not (publication.observed or (publication.frequent and neighbours)):
            self._urgent = True
        self._leaving.append((publication, value))
        if not self._working:
            self._drain()

    def enter(self, work: Callable[..., None], *arguments: Any) -> None:
        """Do what an event asks for, and all that follows from it in this process; then publish."""
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
        """The executor that runs the nodes' callbacks."""
        self._executor = executor
        while self._early:
            executor.create_task(self.enter, *self._early.popleft())

    def from_thread(self, work: Callable[..., None], *arguments: Any) -> None:
        """Do something on the executor's thread, soon; any thread may call this. What it raises would end the process: it must not."""
        if self._executor is None:
            self._early.append((work, *arguments))
        else:
            self._executor.create_task(self.enter, work, *arguments)


def foreign_writers(node: Node, topic: str, known: set[str]) -> list[str]:
    """Fully qualified names of nodes that publish a topic and are not among `known`; a node that is not known by name yet has none."""
    found = {f"{info.node_namespace.rstrip('/')}/{info.node_name}" for info in node.get_publishers_info_by_topic(topic)
             if info.node_name != UNNAMED}
    return sorted(name for name in found if name not in known)
