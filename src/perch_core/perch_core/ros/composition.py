"""Topics with a message at every step, between nodes of one process.

rclcpp has intra-process communication, rclpy has not: there a message to a neighbour goes through the middleware, which costs
20 to 60 us for each reader, and ten are read at every step. Nodes of a composition hand them on directly instead. Other
processes get them through the middleware as ever, a few steps at a time where the neighbours need nobody else to go on: a
message that wakes a process costs 100 us, one that comes with it 30.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from contextlib import contextmanager
from typing import Any, Iterator

from rclpy.clock import Clock, ClockType
from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile

BURST = 40       # messages that are handed on before the executor looks at other events
MOST_SPARE = 20  # pieces of work that wait for spare time; where there is none they are done all the same
ASKED = 10       # sendings between two looks at who listens in other processes

Receive = Callable[[bytes], None]


class FastPublisher:
    """A publisher of serialised messages that serves its neighbours directly."""

    def __init__(self, publisher: Publisher, composition: Composition, urgent: bool) -> None:
        self._publisher, self._composition, self._urgent = publisher, composition, urgent
        self._neighbours: list[Receive] = []

    @property
    def topic_name(self) -> str:
        """Resolved name of the topic."""
        return self._publisher.topic_name

    def get_subscription_count(self) -> int:
        """Matched subscriptions of the middleware; neighbours are not among them."""
        return self._publisher.get_subscription_count()

    @property
    def heard(self) -> bool:
        """Whether anybody would receive a message now."""
        return bool(self._neighbours) or self._composition.heard_outside(self._publisher)

    def add_neighbour(self, receive: Receive) -> None:
        """Hand every message to `receive` from now on."""
        self._neighbours.append(receive)

    def publish(self, data: bytes) -> None:
        """Publish a serialised message."""
        for receive in self._neighbours:
            receive(data)
        if self._urgent and not self._neighbours:
            self._publisher.publish(data)
        else:
            self._composition.send(self._publisher, data)


class Composition:
    """The nodes of this process and what they say to each other at every step.

    Nodes that are created within `creating()` are neighbours once `connect` has been called. All others, alone in their
    process or in a test, have subscriptions of the middleware.
    """

    def __init__(self) -> None:
        self._creating = self._gathering = self._patient = False
        self._publishers: dict[str, FastPublisher] = {}
        self._subscriptions: list[tuple[str, Receive, Callable[[], Any]]] = []
        self._messages: deque[tuple[Receive, bytes]] = deque()  # the one under way is the first
        self._leaving: list[tuple[Publisher, bytes]] = []
        self._heard: dict[Publisher, bool] = {}  # outside, as of the last look
        self._sendings = 0  # since then
        self._later: list[Callable[[], None]] = []
        self._spare: deque[Callable[[], None]] = deque()
        self._until = 0  # spare time ends then, monotonic clock [ns]
        self._executor: EventsExecutor | None = None

    # -- wiring ------------------------------------------------------------------------------------------------------

    @contextmanager
    def creating(self) -> Iterator[None]:
        """Nodes that are created in here are neighbours."""
        self._publishers, self._subscriptions, self._creating = {}, [], True
        try:
            yield
        finally:
            self._creating = False

    def publisher(self, node: Node, msg_type: type, topic: str, profile: QoSProfile, urgent: bool = True) -> FastPublisher:
        """A publisher of a fast topic; `urgent`: without neighbours somebody else needs each message to go on."""
        fast = FastPublisher(node.create_publisher(msg_type, topic, profile), self, urgent)
        if self._creating:
            self._publishers[fast.topic_name] = fast
        return fast

    def subscription(self, node: Node, msg_type: type, topic: str, callback: Receive, profile: QoSProfile) -> None:
        """Have the executor call `callback` with each serialised message of a fast topic."""
        self.subscribe(node.resolve_topic_name(topic), lambda data: self._queue(callback, data),
                       lambda: node.create_subscription(msg_type, topic, callback, profile, raw=True))

    def subscribe(self, topic: str, receive: Receive, subscribe: Callable[[], Any]) -> None:
        """Take part in a fast topic.

        Args:
            topic: its resolved name.
            receive: called with each message of a neighbour, within its `publish`.
            subscribe: subscribes by the middleware; called where no neighbour publishes the topic.
        """
        if self._creating:
            self._subscriptions.append((topic, receive, subscribe))
        else:
            subscribe()

    def connect(self, executor: EventsExecutor) -> None:
        """Connect the nodes, which are all there and have been added to their executor."""
        self._executor = executor
        for topic, receive, subscribe in self._subscriptions:
            if topic in self._publishers:
                self._publishers[topic].add_neighbour(receive)
            else:
                subscribe()

    # -- messages ----------------------------------------------------------------------------------------------------

    def flush(self) -> None:
        """Send what waits to leave the process. Call it before a message for which others shall know all that came before."""
        leaving, self._leaving = self._leaving, []
        self._sendings += 1
        if self._sendings >= ASKED:
            self._heard, self._sendings = {}, 0
        for publisher, data in leaving:
            if self.heard_outside(publisher):
                publisher.publish(data)

    def heard_outside(self, publisher: Publisher) -> bool:
        """Whether another process listens. Where messages wait for `flush` the middleware, which takes 5 us, is asked at every tenth."""
        if not self._patient:
            return publisher.get_subscription_count() > 0
        heard = self._heard.get(publisher)
        if heard is None:
            heard = self._heard[publisher] = publisher.get_subscription_count() > 0
        return heard

    def hold_back(self, patient: bool = True) -> None:
        """Whether messages for other processes wait for `flush`: who wants this paces the process, and flushes every few steps."""
        self._patient = patient

    def at_once(self, work: Callable[[], None], until: int = 0) -> None:
        """Do `work` and hand on at its end what it has published: a turn of the executor costs 50 us.

        Args:
            work: what publishes.
            until: when the next step is due, by the monotonic clock [ns]; what has time is begun before.
        """
        self._gathering, self._until = not self._messages, until
        try:
            work()
        finally:
            gathering, self._gathering = self._gathering, False
        if gathering and self._messages:
            self._hand_on_burst()
        elif gathering:
            self._catch_up()

    def later(self, work: Callable[[], None]) -> None:
        """Do what nobody waits for: when the neighbours have no more to say to each other, and at once where none speaks."""
        if self._messages:
            self._later.append(work)
        else:
            work()

    def in_spare_time(self, work: Callable[[], None]) -> None:
        """Do what may wait for steps that leave time for it; `later` where the process is not paced (`hold_back`)."""
        if self._patient:
            self._spare.append(work)
        else:
            self.later(work)

    def send(self, publisher: Publisher, data: bytes) -> None:
        """Send a message to other processes: at once, when the neighbours have no more to say to each other, or with others."""
        if self._messages or self._patient:
            self._leaving.append((publisher, data))
        else:
            publisher.publish(data)

    def _queue(self, receive: Receive, data: bytes) -> None:
        if not self._messages and not self._gathering:
            self._executor.create_task(self._hand_on)
        self._messages.append((receive, data))

    def _hand_on(self) -> None:
        """An exception out of a task is a segmentation fault in rclpy 7.1.6; out of a timer it ends the program with its traceback."""
        try:
            self._hand_on_burst()
        except Exception as error:
            def fail(error: Exception = error) -> None:
                raise error

            next(iter(self._executor.get_nodes())).create_timer(0.0, fail, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _hand_on_burst(self) -> None:
        """Hand on waiting messages in the order in which they were published, and those that follow from them; then what has time."""
        messages = self._messages
        for _ in range(BURST):
            receive, data = messages[0]
            try:
                receive(data)
            finally:
                messages.popleft()
            if not messages:
                break
        else:
            self._executor.create_task(self._hand_on)
        if not self._patient:
            self.flush()
        if not messages:
            self._catch_up()

    def _catch_up(self) -> None:
        """Do what has waited until the neighbours have no more to say to each other, and as much of the rest as there is time for."""
        later, self._later = self._later, []
        for work in later:
            work()
        spare = self._spare
        while spare and (len(spare) > MOST_SPARE or time.monotonic_ns() < self._until):
            spare.popleft()()


composition = Composition()
