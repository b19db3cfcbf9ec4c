"""Neighbours hand fast topics on directly; others get the same messages through the middleware."""

import os
import time
from dataclasses import dataclass

import pytest
import rclpy
from perch_msgs.msg import MotorCommand
from rclpy.context import Context
from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from rclpy.serialization import serialize_message

from perch_core.ros import composition as module
from perch_core.ros import qos
from perch_core.ros.composition import Composition
from perch_core.ros.conversions import to_stamp
from perch_core.ros.node import PerchNode
from perch_core.ros.wire import stamp_of


@dataclass(frozen=True)
class NoParameters:
    """None."""


def message(number: int) -> bytes:
    msg = MotorCommand()
    msg.header.stamp = to_stamp(number)
    return serialize_message(msg)


class Process:
    """Two nodes of one process, and a stranger that has only the middleware."""

    def __init__(self, monkeypatch):
        self.composition = Composition()
        monkeypatch.setattr(module, "composition", self.composition)
        monkeypatch.setattr("perch_core.ros.node.composition", self.composition)
        self.context = Context()
        rclpy.init(context=self.context, domain_id=int(os.environ["ROS_DOMAIN_ID"]))
        self.executor = EventsExecutor(context=self.context)
        self.heard, self.overheard = [], []
        with self.composition.creating():
            self.listener = PerchNode("listener", NoParameters, context=self.context)
            self.composition.subscription(self.listener, MotorCommand, "fast", self.receive, qos.CHAIN)
            self.composition.subscription(self.listener, MotorCommand, "foreign", self.receive, qos.CHAIN)
            self.backlog = self.listener.create_backlog(MotorCommand, "fast", qos.CHAIN)
            self.talker = Node("talker", context=self.context)
            self.fast = self.composition.publisher(self.talker, MotorCommand, "fast", qos.CHAIN)
            self.shown = self.composition.publisher(self.talker, MotorCommand, "shown", qos.CHAIN, urgent=False)
            self.awaited = self.composition.publisher(self.talker, MotorCommand, "awaited", qos.CHAIN)
        self.stranger = Node("stranger", context=self.context)
        self.foreign = self.composition.publisher(self.stranger, MotorCommand, "foreign", qos.CHAIN)
        self.on_message = lambda number: None
        for node in (self.listener, self.talker, self.stranger):
            self.executor.add_node(node)
        self.composition.connect(self.executor)

    def receive(self, data: bytes) -> None:
        self.heard.append(stamp_of(data))
        self.on_message(self.heard[-1])

    def overhear(self, *topics: str) -> None:
        for topic in topics or ("fast",):
            self.stranger.create_subscription(MotorCommand, topic, lambda data: self.overheard.append(stamp_of(data)), qos.CHAIN, raw=True)
            self.until(lambda topic=topic: getattr(self, topic).get_subscription_count() == 1)

    def until(self, done):
        last = time.monotonic() + 10.0
        while not done():
            assert time.monotonic() < last, "did not happen"
            self.executor.spin_once(timeout_sec=0.01)

    def close(self):
        self.executor.shutdown()
        for node in (self.listener, self.talker, self.stranger):
            node.destroy_node()
        self.context.try_shutdown()


@pytest.fixture
def process(ros_domain, monkeypatch):
    out = Process(monkeypatch)
    yield out
    out.close()


def test_neighbours_need_no_subscription(process):
    assert process.talker.count_subscribers("fast") == 0
    process.fast.publish(message(1))
    assert process.heard == []  # from the executor, not within publish
    process.until(lambda: process.heard == [1])
    assert [stamp_of(data) for data in process.backlog.take()] == [1] and process.backlog.take() == []


def test_a_backlog_keeps_as_many_as_the_topic(process):
    for k in range(qos.CHAIN.depth + 20):
        process.fast.publish(message(k))
    assert [stamp_of(data) for data in process.backlog.take()] == list(range(20, qos.CHAIN.depth + 20))


def test_what_no_neighbour_publishes_comes_through_the_middleware(process):
    process.until(lambda: process.foreign.get_subscription_count() == 1)
    process.foreign.publish(message(7))
    process.until(lambda: process.heard == [7])


def test_a_dialogue_keeps_its_order_and_strangers_hear_all_of_it(process):
    """Each message is answered by the next from within the callback, so the neighbours always have something to say."""
    process.overhear()
    process.on_message = lambda number: process.fast.publish(message(number + 1)) if number < 500 else None
    process.fast.publish(message(1))
    process.until(lambda: len(process.overheard) == 500)
    assert process.heard == process.overheard == list(range(1, 501))


def test_other_events_are_served_in_a_dialogue_without_end(process):
    served = []
    process.on_message = lambda number: process.fast.publish(message(number + 1))
    process.talker.create_timer(0.01, lambda: served.append(len(process.heard)))
    process.fast.publish(message(1))
    process.until(lambda: len(served) >= 3)
    assert served[0] < served[1] < served[2]


def test_what_leaves_waits_for_the_neighbours_unless_it_is_flushed(process):
    process.overhear()
    order = []
    process.fast._publisher = Spy(process.fast._publisher, order)

    def answer(number: int) -> None:
        order.append(f"handled {number}")
        if number < 3:
            process.fast.publish(message(number + 1))
        if number == 2:
            process.composition.flush()

    process.on_message = answer
    process.fast.publish(message(1))
    process.until(lambda: len(process.overheard) == 3)
    assert order == ["handled 1", "handled 2", "sent 1", "sent 2", "sent 3", "handled 3"]


def test_a_process_that_holds_back_sends_several_steps_together(process):
    """But not what strangers alone receive and answer."""
    process.overhear("fast", "shown", "awaited")
    process.composition.hold_back()
    sent = []
    for fast in (process.fast, process.shown, process.awaited):
        fast._publisher = Spy(fast._publisher, sent)
    for number, fast in enumerate((process.fast, process.shown, process.awaited), 1):
        fast.publish(message(number))
    process.until(lambda: process.heard == [1])
    assert sent == ["sent 3"]
    process.composition.flush()
    assert sent == ["sent 3", "sent 1", "sent 2"]
    process.until(lambda: sorted(process.overheard) == [1, 2, 3])


def test_what_nobody_hears_does_not_leave(process):
    sent = []
    process.fast._publisher = Spy(process.fast._publisher, sent)
    process.fast.publish(message(1))
    process.until(lambda: process.heard == [1])
    assert sent == []


def test_who_begins_to_listen_is_heard_of_ten_sendings_later(process):
    process.composition.hold_back()
    assert not process.shown.heard
    process.overhear("shown")
    assert not process.shown.heard
    for _ in range(module.ASKED):
        process.composition.flush()
    assert process.shown.heard


def test_a_dialogue_at_once_needs_no_turn_of_the_executor(process):
    order = []

    def answer(number: int) -> None:
        process.composition.later(lambda: order.append(f"after {number}"))
        if number < 3:
            process.fast.publish(message(number + 1))

    process.on_message = answer

    def speak() -> None:
        process.fast.publish(message(1))
        order.append(f"heard {process.heard} so far")

    process.composition.at_once(speak)
    assert order.pop(0) == "heard [] so far"
    assert process.heard == [1, 2, 3] and order == ["after 1", "after 2", "after 3"]
    process.fast.publish(message(3))
    assert process.heard == [1, 2, 3]
    process.until(lambda: process.heard == [1, 2, 3, 3])


def in_a_step(process, work, until):
    """One step of a process that is paced: a message, and in its callback pieces of work."""
    process.on_message = lambda number: [process.composition.in_spare_time(piece) for piece in work]
    process.composition.at_once(lambda: process.fast.publish(message(1)), until)


def test_work_waits_for_a_step_that_leaves_time_for_it(process):
    process.composition.hold_back()
    order, soon = [], time.monotonic_ns() + 10_000_000_000
    in_a_step(process, [lambda: order.append("first")], until=0)
    assert order == []
    in_a_step(process, [lambda: order.append("second")], until=soon)
    assert order == ["first", "second"]


def test_work_of_a_node_without_neighbours_is_done_too(process):
    process.composition.hold_back()
    order, soon = [], time.monotonic_ns() + 10_000_000_000
    process.composition.in_spare_time(lambda: order.append("first"))
    process.composition.at_once(lambda: process.composition.in_spare_time(lambda: order.append("second")), soon)
    assert order == ["first", "second"]


def test_work_that_never_finds_time_is_done_all_the_same(process):
    process.composition.hold_back()
    order = []
    for k in range(module.MOST_SPARE + 2):
        in_a_step(process, [lambda k=k: order.append(k)], until=0)
    assert order == [0, 1]


def test_spare_time_is_that_of_a_paced_process(process):
    order = []
    in_a_step(process, [lambda: order.append("done")], until=0)
    assert order == ["done"]


def test_what_has_time_is_done_when_the_neighbours_have_no_more_to_say(process):
    order = []

    def answer(number: int) -> None:
        process.composition.later(lambda: order.append(f"after {number}"))
        order.append(number)
        if number < 3:
            process.fast.publish(message(number + 1))

    process.on_message = answer
    process.fast.publish(message(1))
    process.until(lambda: len(order) == 6)
    assert order == [1, 2, 3, "after 1", "after 2", "after 3"]
    process.composition.later(lambda: order.append("at once"))
    assert order[-1] == "at once"


def test_an_error_ends_the_program(process):
    def fail(number: int) -> None:
        raise ZeroDivisionError(f"message {number}")

    process.on_message = fail
    process.fast.publish(message(3))
    with pytest.raises(ZeroDivisionError, match="message 3"):
        process.until(lambda: False)


class Spy:
    """A publisher that notes what is sent."""

    def __init__(self, publisher, order):
        self._publisher, self._order = publisher, order

    def publish(self, data: bytes) -> None:
        self._order.append(f"sent {stamp_of(data)}")
        self._publisher.publish(data)

    def get_subscription_count(self) -> int:
        return self._publisher.get_subscription_count()
