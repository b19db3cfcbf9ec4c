"""Subscriptions of the arrival host."""

from __future__ import annotations

from contextlib import nullcontext
from types import SimpleNamespace

import pytest

pytest.importorskip("rclpy")

from perch_core.ros.intake import TAKE_MAX, Intake  # noqa: E402
from perch_core.ros.wiring import Wiring  # noqa: E402


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
