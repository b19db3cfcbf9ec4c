"""Publication of values: what cannot be a message is dropped, and the rest is published."""

from __future__ import annotations

import struct
from collections import deque
from types import SimpleNamespace

from perch_core.ros.messages import fast
from perch_core.ros.wiring import Publication, Wiring
from perch_core.values import NANOSECONDS, ImuSample


def test_a_value_without_a_message_is_dropped_and_the_others_are_published():
    sent, failures, wiring = [], [], Wiring()
    publisher = SimpleNamespace(topic_name="/imu", get_subscription_count=lambda: 1, publish=sent.append)
    publication = Publication(publisher, fast.pack_imu, False, lambda topic, error: failures.append((topic, type(error))))
    for seconds in (1, 1 << 40, 2):  # the second stamp does not fit into its message
        wiring.enter(lambda: wiring.emit("/imu", publication, ImuSample(seconds * NANOSECONDS, (0.0,) * 3, (0.0, 0.0, 9.81))))
    assert len(sent) == 2 and failures == [("/imu", struct.error)]


def test_a_value_that_the_middleware_refuses_is_dropped_and_the_others_are_published():
    sent, failures, wiring = [], [], Wiring()

    def publish(message):
        if message == 1:
            raise RuntimeError("failed to publish")
        sent.append(message)

    publisher = SimpleNamespace(topic_name="/imu", publish=publish)
    publication = Publication(publisher, int, True, lambda topic, error: failures.append((topic, str(error))))
    wiring.enter(lambda: [wiring.emit("/imu", publication, value) for value in (0, 1, 2)])
    assert sent == [0, 2] and failures == [("/imu", "failed to publish")]


def test_work_that_raises_delays_nothing_that_follows():
    done, failures, wiring = [], [], Wiring()
    wiring.on_failure = lambda name, error: failures.append(str(error))

    def fail():
        wiring.enter(done.append, "follows")
        raise RuntimeError("failed to take a message")

    wiring.enter(fail)
    assert done == ["follows"] and failures == ["failed to take a message"]


def test_work_that_a_thread_queues_while_the_executor_is_set_is_not_lost():
    """A job may end between the thread's look for the executor and its entry into the queue, which the executor has taken by then."""
    wiring, done = Wiring(), []
    executor = SimpleNamespace(create_task=lambda call, *work: call(*work))

    class Interrupted(deque):
        def append(self, work):
            wiring.run_on(executor)
            super().append(work)

    wiring._pending = Interrupted()
    wiring.from_thread(done.append, "job")
    assert done == ["job"]
