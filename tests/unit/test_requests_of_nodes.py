"""Requests of a node to another one's service, which it may not have discovered yet."""

import time
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("rclpy")

from perch_core.component import Client, Component, Service, Unavailable  # noqa: E402
from perch_core.ros.arrival import ArrivalNode  # noqa: E402
from perch_core.ros.node import close_nodes  # noqa: E402
from perch_core.ros.service_clients import _answer  # noqa: E402
from perch_core.ros.wiring import Wiring  # noqa: E402
from perch_core.values.planning import PerchPlan, PerchPlanRequest  # noqa: E402

PATIENCE = 120.0  # only ever waited for in full when a test fails [s]
REQUEST = PerchPlanRequest(start=0, p=np.zeros(3), p_WS=np.array([1.7, 0.0, 0.0]), q_WS=np.array([1.0, 0.0, 0.0, 0.0]))
NONE = PerchPlan(success=False, error_code=2, message="there is no plan")


@dataclass(frozen=True)
class Nothing:
    """No parameters."""


class Asking(Component[Nothing]):
    """Asks, and keeps the answers."""

    config_type = Nothing
    plan_perch = Client(PerchPlanRequest, PerchPlan, "plan_perch")

    def on_plan_perch(self, request: PerchPlanRequest, answer: PerchPlan | Unavailable) -> None:
        """Keep it."""
        self.answers = [*getattr(self, "answers", []), answer]


class Serving(Component[Nothing]):
    """Answers."""

    config_type = Nothing
    plan_perch = Service(PerchPlanRequest, PerchPlan, "plan_perch")

    def on_plan_perch(self, request, reply) -> None:
        """At once."""
        reply(NONE)


def node(executor, kind):
    """A node of a component, in a process of its own as far as its neighbours can tell."""
    one = ArrivalNode(kind.__name__.lower(), kind, Wiring(), context=executor.context)
    one.connect()
    executor.add_node(one)
    return one


def until(executor, done):
    """Run callbacks until `done`."""
    end = time.monotonic() + PATIENCE
    while not done():
        assert time.monotonic() < end, "it does not come"
        executor.spin_once(0.1)


def test_a_request_waits_for_the_discovery_of_its_service(executor):
    asking = node(executor, Asking).component
    asking.plan_perch(REQUEST, 0)
    executor.spin_once(0.1)
    node(executor, Serving)
    until(executor, lambda: getattr(asking, "answers", []))
    assert [answer.message for answer in asking.answers] == [NONE.message]


def test_a_service_that_nobody_offers_is_named(executor, monkeypatch):
    monkeypatch.setattr("perch_core.ros.service_clients.DISCOVERY_TIMEOUT", 0.1)
    asking = node(executor, Asking).component
    asking.plan_perch(REQUEST, 0)
    until(executor, lambda: getattr(asking, "answers", []))
    assert asking.answers == [Unavailable("service plan_perch is not available")]


@pytest.mark.slow
def test_a_server_that_is_started_anew_while_nobody_asks_is_told(executor, monkeypatch):
    monkeypatch.setattr("perch_core.ros.service_clients.WATCH_PERIOD", 0.02)
    asking, told = node(executor, Asking), []
    asking.component.log.receivers.append(lambda line: told.append(line.text))
    first = node(executor, Serving)
    until(executor, lambda: asking.get_publishers_info_by_topic("rr/plan_perchReply", no_mangle=True))
    for _ in range(20):
        executor.spin_once(0.02)
    assert not told
    executor.remove_node(first), close_nodes([first])
    node(executor, Serving)
    until(executor, lambda: told)
    assert told == ["plan_perch: server restarted or second server detected"]


class Silent(Serving):
    """Takes a request, and ends before its answer."""

    def on_plan_perch(self, request, reply) -> None:
        """Never."""
        self.asked = True


@pytest.mark.slow
def test_a_request_whose_server_ended_is_answered_by_the_one_that_was_started_anew_and_once(executor):
    asking, silent = node(executor, Asking).component, node(executor, Silent)
    asking.plan_perch(REQUEST, 0)
    until(executor, lambda: hasattr(silent.component, "asked"))
    for _ in range(2):
        node(executor, Serving)
    until(executor, lambda: getattr(asking, "answers", []))
    for _ in range(20):
        executor.spin_once(0.05)
    assert [answer.message for answer in asking.answers] == [NONE.message]


def test_a_request_to_a_server_that_hangs_ends(executor, monkeypatch):
    monkeypatch.setattr("perch_core.ros.service_clients.ANSWER_TIMEOUT", 0.3)
    asking, silent = node(executor, Asking).component, node(executor, Silent)
    asking.plan_perch(REQUEST, 0)
    until(executor, lambda: getattr(asking, "answers", []))
    assert asking.answers == [Unavailable("plan_perch has not answered within 0.3 s")]
    executor.remove_node(silent), close_nodes([silent])


class Counting(Serving):
    """Answers, and counts."""

    count = 0

    def on_plan_perch(self, request, reply) -> None:
        """At once."""
        self.count += 1
        super().on_plan_perch(request, reply)


def test_of_several_requests_to_a_server_that_ended_only_the_newest_reaches_the_next_one(executor):
    asking, silent = node(executor, Asking), node(executor, Silent)
    until(executor, lambda: asking.get_publishers_info_by_topic("rr/plan_perchReply", no_mangle=True))
    for _ in range(3):
        asking.component.plan_perch(REQUEST, 0)
    until(executor, lambda: hasattr(silent.component, "asked"))
    executor.remove_node(silent), close_nodes([silent])
    counting = node(executor, Counting).component
    until(executor, lambda: len(getattr(asking.component, "answers", [])) == 3)
    assert asking.component.answers.count(Unavailable("plan_perch: the server has ended")) == 2 and counting.count == 1


def test_a_request_that_has_no_message_is_answered(executor):
    asking = node(executor, Asking).component
    node(executor, Serving)
    asking.plan_perch(replace(REQUEST, p="nowhere"), 0)
    until(executor, lambda: getattr(asking, "answers", []))
    assert "plan_perch: the request cannot be sent" in asking.answers[0].reason


def test_a_response_that_cannot_be_read_is_an_answer():
    row = SimpleNamespace(channel="plan_perch", answer_value=lambda response: 1 / response)
    assert _answer(row, SimpleNamespace(result=lambda: 0)) == Unavailable("plan_perch sent an invalid response: division by zero")


class Wrong(Serving):
    """Replies with what is no answer."""

    def on_plan_perch(self, request, reply) -> None:
        """At once."""
        reply(replace(NONE, solve_time="long"))


def test_a_reply_that_has_no_message_is_a_refusal(executor):
    asking = node(executor, Asking).component
    wrong = node(executor, Wrong)
    asking.plan_perch(REQUEST, 0)
    until(executor, lambda: getattr(asking, "answers", []))
    assert not asking.answers[0].success and "the answer has no message" in asking.answers[0].message and wrong._failures == 1
