"""Subscriptions of the arrival host."""

from __future__ import annotations

from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("rclpy")

from perch_core.component import Component, Input, Output, ports  # noqa: E402
from perch_core.ros import topics  # noqa: E402
from perch_core.ros.arrival import ArrivalNode  # noqa: E402
from perch_core.ros.intake import TAKE_MAX, Intake  # noqa: E402
from perch_core.ros.node import connect  # noqa: E402
from perch_core.ros.wiring import Wiring  # noqa: E402
from perch_core.values import NANOSECONDS, Command, ControllerCommand, InertialState, MotorCommand, Serialized, Transform  # noqa: E402
from rclpy.node import Node  # noqa: E402
from unit.test_requests_of_nodes import Nothing, until  # noqa: E402


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


class Ordering(Component[Nothing]):
    """Orders, as a mission does."""

    config_type = Nothing
    command = Output(ControllerCommand, "controller/command")


class Obeying(Component[Nothing]):
    """Keeps what it is ordered, and answers with motor commands."""

    config_type = Nothing
    command = Input(ControllerCommand, "controller/command")
    motor_command = Output(MotorCommand, "motor_command")

    def __init__(self, config):
        super().__init__(config)
        self.reasons = []

    def on_command(self, command):
        """Keep it."""
        self.reasons.append(command.reason)


class Recording(Component[Nothing]):
    """Takes the motor commands as bytes."""

    config_type = Nothing
    motor_command = Input(Serialized, "motor_command")

    def on_motor_command(self, _):
        """Not called here."""


class Turning(Recording):
    """Takes the motor commands as a vehicle does."""

    motor_command = Input(MotorCommand, "motor_command")


class Plain(Node):
    """A node of somebody else."""

    def close(self) -> None:
        """It has nothing to release."""


def command(number: Command, reason: str) -> object:
    """A message to the controller."""
    return topics.topic("controller/command").to_message(ControllerCommand(0, int(number), reason))


def outside(executor, node: ArrivalNode):
    """A publisher in another node, as of a ground station, that the node has discovered."""
    station, row = Plain("station", context=executor.context), topics.topic("controller/command")
    publisher = station.create_publisher(row.message, "controller/command", 2000)
    executor.add_node(station)
    until(executor, lambda: publisher.get_subscription_count() and node.count_publishers("controller/command"))
    return publisher


def test_commands_from_outside_are_obeyed_beside_those_of_a_neighbour_each_once(executor):
    wiring = Wiring()
    ordering, obeying = (ArrivalNode(kind.__name__.lower(), kind, wiring, context=executor.context) for kind in (Ordering, Obeying))
    connect([ordering, obeying], executor)
    station, reasons = outside(executor, obeying), obeying.component.reasons
    until(executor, lambda: ordering.count_subscribers("controller/command"))
    for k in range(3):
        ordering.component.command(ControllerCommand(k, Command.HOVER, f"mission {k}"))
        assert reasons[-1] == f"mission {k}", "at once"
        station.publish(command(Command.KILL, f"station {k}"))
        until(executor, lambda: f"station {k}" in reasons)
    assert reasons == [f"{sender} {k}" for k in range(3) for sender in ("mission", "station")]


def test_a_kill_before_or_after_a_flood_of_other_commands_is_taken(executor, monkeypatch):
    node = ArrivalNode("obeying", Obeying, Wiring(), context=executor.context)
    connect([node], executor)
    station, reasons = outside(executor, node), node.component.reasons
    monkeypatch.setattr("perch_core.ros.intake.int", lambda _: 7, raising=False)  # all are read in the same second
    station.publish(command(Command.KILL, "before"))
    for _ in range(700):
        station.publish(command(Command.HOVER, "flood"))
    station.publish(command(Command.KILL, "after"))
    until(executor, lambda: "after" in reasons)
    assert reasons[0] == "before" and reasons.count("flood") == topics.topic("controller/command").rate_max


def test_who_only_observes_the_motor_commands_is_no_vehicle(executor):
    wiring = Wiring()
    obeying = ArrivalNode("obeying", Obeying, wiring, deadline="motor_command", context=executor.context)
    connect([obeying, ArrivalNode("recording", Recording, wiring, context=executor.context)], executor)
    emitter, message = obeying.component.motor_command, topics.message_type("motor_command")
    for k, name in enumerate(("recorder", "_ros2cli_1234", "rosbag2_recorder")):
        observer = Plain(name, context=executor.context)
        observer.create_subscription(message, "motor_command", lambda _: None, 10)
        executor.add_node(observer)
        until(executor, lambda: len(obeying.get_subscriptions_info_by_topic("/motor_command")) == k + 1)
        assert not emitter.has_receivers
    vehicle = Plain("my_esc", context=executor.context)
    vehicle.create_subscription(message, "motor_command", lambda _: None, 10)
    executor.add_node(vehicle)
    until(executor, lambda: emitter.has_receivers)


def test_a_vehicle_in_the_process_takes_the_motor_commands(executor):
    wiring = Wiring()
    obeying = ArrivalNode("obeying", Obeying, wiring, deadline="motor_command", context=executor.context)
    connect([obeying, ArrivalNode("turning", Turning, wiring, context=executor.context)], executor)
    assert obeying.component.motor_command.has_receivers
