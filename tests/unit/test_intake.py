"""Subscriptions of the arrival host."""

from __future__ import annotations

from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("rclpy")

from perch_core.component import Component, Input, ports  # noqa: E402
from perch_core.ros.intake import TAKE_MAX, Intake  # noqa: E402
from perch_core.ros.wiring import Wiring  # noqa: E402
from perch_core.values import NANOSECONDS, InertialState, Serialized, Transform  # noqa: E402


class Listening(Component[None]):
    """Takes transforms, and the states of VIO as their bytes."""

    frames = Input(Transform, "/tf_static")
    recorded = Input(Serialized, "vio/state")

    def __init__(self) -> None:
        super().__init__(None)
        self.taken: list[Serialized] = []

    def on_frames(self, _: Transform) -> None:
        """Not called here."""

    def on_recorded(self, message: Serialized) -> None:
        self.taken.append(message)


@pytest.fixture
def host() -> SimpleNamespace:
    """A node in a namespace, as `perch_eval.nodes.in_namespace` remaps it, whose neighbours publish all that it takes."""
    node = SimpleNamespace(wiring=Wiring(), component=Listening(), failures=[], subscribed=[])

    def guarded(_, work, *arguments):
        try:
            work(*arguments)
        except Exception as error:
            node.failures.append(error)

    node.guarded, node.resolve_topic_name = guarded, lambda channel: f"/quad1/{channel.lstrip('/')}"
    node.create_subscription = lambda _, channel, *__, **___: node.subscribed.append(channel)
    node.intake = Intake(node)
    for port in ports(Listening, Input):
        node.wiring.register_writer(node.resolve_topic_name(port.channel(node.component)), "/quad1/other")
        node.intake.add(port)
    return node


def test_transforms_of_other_processes_are_taken_in_a_namespace_too(host):
    assert host.subscribed == ["/tf_static"] and host.intake.private == {"/quad1/vio/state"}


def test_a_neighbours_value_without_a_message_is_dropped_and_the_next_one_is_taken(host):
    publication = SimpleNamespace(observed=False, frequent=True, send=lambda _: None)
    for size in (2, 3):  # of the position
        state = InertialState(NANOSECONDS, np.zeros(size), np.array([0.0, 0.0, 0.0, 1.0]), *np.zeros((3, 3)), np.eye(15))
        host.wiring.emit("/quad1/vio/state", publication, state)
    assert [message.stamp for message in host.component.taken] == [NANOSECONDS] and len(host.failures) == 1


class Flooded(nullcontext):
    """A subscription's handle whose messages never end, up to a number at which the test ends."""

    left = 100_000

    def take_message(self, *_):
        """One more."""
        self.left -= 1
        assert self.left, "other events are never processed"
        return b"", None


def test_a_flood_on_one_topic_leaves_time_for_the_others_and_for_other_events():
    intake = Intake(SimpleNamespace(wiring=Wiring()))
    taken: dict[str, list[bytes]] = {"first": [], "second": []}
    intake._lazy = [(SimpleNamespace(handle=Flooded(), msg_type=None), received.append) for received in taken.values()]
    events: list[str] = []
    intake.enter(events.append, "stop")
    assert events == ["stop"] and [len(received) for received in taken.values()] == [TAKE_MAX, TAKE_MAX]
