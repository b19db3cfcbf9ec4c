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
from contextlib import suppress
from typing import Any

from rclpy.node import Node
from rclpy.publisher import Publisher

UNNAMED = "_NODE_NAME_UNKNOWN_"  # of rcl, for a publisher that was discovered before its node
OBSERVERS = ("recorder", "viewer", "preflight", "rosbag2_", "foxglove_bridge", "rqt_", "rviz", "plotjuggler", "_")
"""Beginnings of the names of nodes that only observe. A leading underscore hides a node, as those of the command line `ros2`."""
CHECK_PERIOD = 0.1     # of the check for subscribers, which takes 5 us [s]
BUNDLE_PERIOD = 0.008  # of the publication of messages without urgency [s]

Receive = Callable[[Any], None]


class Publication:
    """A topic that leaves the process if it has subscribers."""

    def __init__(self, publisher: Publisher, to_message: Callable[[Any], Any], always: bool, on_failure: Callable[[str, Exception], None],
                 frequent: bool = False, observed: bool = False) -> None:
        """
        Args:
            publisher: publisher of the topic.
            to_message: value to message, or to a serialised one.
            always: publish also without subscribers: a latched topic keeps its last message for late subscribers.
            on_failure: called with the topic and the exception if a value cannot be published; the value is dropped.
            frequent: as `Topic.frequent`; its message may be delayed if a neighbour takes the value.
            observed: no component in flight waits for it.
        """
        self._publisher, self._to_message, self._always, self._on_failure = publisher, to_message, always, on_failure
        self.frequent, self.observed = frequent, observed
        self._has_subscribers, self._last_check = False, 0.0

    def has_subscribers(self) -> bool:
        """Return whether the topic has subscribers, or is published without them."""
        if self._always:
            return True
        now = time.monotonic()
        if now - self._last_check > CHECK_PERIOD:
            self._has_subscribers, self._last_check = self._publisher.get_subscription_count() > 0, now
        return self._has_subscribers

    def send(self, value: Any) -> None:
        """Publish a value if `has_subscribers`."""
        if self.has_subscribers():
            try:
                self._publisher.publish(self._to_message(value))
            except Exception as error:  # the node continues, and the other values of a bundle are published
                self._on_failure(self._publisher.topic_name, error)


class Wiring:
    """Connections among the nodes of one process. A single node has a `Wiring` of its own.

    Attributes:
        participants: nodes that take part in a lockstep, by name, for a vehicle in this process.
        hosts_schedule: whether that vehicle is in this process.
        bundled: the process has deadlines and handles events every few milliseconds; messages without urgency leave in bundles.
        progress: notifies that vehicle that something for which it may be waiting has arrived.
        on_failure: called with a name and an exception that work has raised; the node logs it. By default it is raised again.
    """

    def __init__(self) -> None:
        self._neighbours: dict[str, list[Receive]] = {}
        self._followed: set[str] = set()    # topics with a neighbour that does more than observe
        self._writers: dict[str, str] = {}  # topic -> node of this process that publishes it
        self._queue: deque[tuple[Callable[..., None], tuple[Any, ...]]] = deque()
        self._outgoing: deque[tuple[Publication, Any]] = deque()
        self._working, self._urgent = False, False
        self._last_sent = 0.0  # time of the last publication, monotonic clock [s]
        self._executor: Any = None
        self._pending: deque[tuple[Any, ...]] = deque()  # work that threads have queued for the executor
        self.participants: dict[str, Any] = {}  # of a lockstep, in this process
        self.hosts_schedule = False             # a lockstep's vehicle is in this process
        self.bundled = False
        self.progress: Callable[[], None] = lambda: None
        self.on_failure: Callable[[str, Exception], None] = _raise

    # -- connecting --------------------------------------------------------------------------------------------------

    def register_writer(self, topic: str, node: str) -> None:
        """Register the node of this process that publishes a topic."""
        self._writers[topic] = node

    def writer(self, topic: str) -> str | None:
        """Return the node of this process that publishes a topic, or None."""
        return self._writers.get(topic)

    def add_reader(self, topic: str, receive: Receive, observer: bool = False) -> None:
        """Pass every value of a topic that is published in this process to `receive`; `observer`: which only records it."""
        self._neighbours.setdefault(topic, []).append(receive)
        if not observer:
            self._followed.add(topic)

    def has_reader(self, topic: str, observers: bool = True) -> bool:
        """Return whether a node of this process receives a topic directly; `observers`: also one that only records it."""
        return topic in (self._neighbours if observers else self._followed)

    # -- working -----------------------------------------------------------------------------------------------------

    def emit(self, topic: str, publication: Publication, value: Any) -> None:
        """Pass a value of a node of this process to its neighbours, and queue it for publication."""
        neighbours = self._neighbours.get(topic, ())
        for receive in neighbours:
            self._queue.append((receive, (value,)))
        if not (publication.observed or (publication.frequent and neighbours)):
            self._urgent = True
        self._outgoing.append((publication, value))
        if not self._working:
            self._drain()

    def enter(self, work: Callable[..., None], *arguments: Any) -> None:
        """Process an event and everything that follows from it in this process; then publish."""
        self._queue.append((work, arguments))
        if not self._working:
            self._drain()

    def _drain(self) -> None:
        queue, outgoing = self._queue, self._outgoing
        self._working = True
        try:
            while queue:
                work, arguments = queue.popleft()
                try:
                    work(*arguments)
                except Exception as error:  # what follows must not wait for the next event
                    self.on_failure("event", error)
            if outgoing and (self._urgent or not self.bundled or time.monotonic() - self._last_sent > BUNDLE_PERIOD):
                while outgoing:
                    publication, value = outgoing.popleft()
                    publication.send(value)
                self._last_sent, self._urgent = time.monotonic(), False
        finally:
            self._working = False

    def run_on(self, executor: Any) -> None:
        """Set the executor that runs the nodes' callbacks, and give it the work that threads have queued; any thread may call this."""
        self._executor = executor
        while self._pending:
            with suppress(IndexError):  # another thread has taken it
                executor.create_task(self.enter, *self._pending.popleft())

    def from_thread(self, work: Callable[..., None], *arguments: Any) -> None:
        """Schedule work on the executor's thread; any thread may call this."""
        self._pending.append((work, *arguments))
        if self._executor is not None:  # read after the work is queued: either this call or `run_on` of another thread finds it
            self.run_on(self._executor)


def is_observer(node: str) -> bool:
    """Return whether a node only observes, by its name; one that was discovered before its name may be a vehicle."""
    return node.startswith(OBSERVERS) and node != UNNAMED


def _raise(_: str, error: Exception) -> None:
    raise error


def foreign_publishers(node: Node, topic: str, known: set[str]) -> list[str]:
    """Return the fully qualified names, as far as discovered, of nodes that publish a topic and are not in `known`."""
    found = {f"{info.node_namespace.rstrip('/')}/{info.node_name}" for info in node.get_publishers_info_by_topic(topic)
             if info.node_name != UNNAMED}
    return sorted(name for name in found if name not in known)
