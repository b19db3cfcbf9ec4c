"""Nodes of the lockstep host, with those that share their process or ask them."""

from __future__ import annotations

import itertools
import os
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("rclpy")

from diagnostic_msgs.msg import DiagnosticStatus  # noqa: E402
from perch_core.component import Action, Client, Component, Output, Service, Timer, Unavailable  # noqa: E402
from perch_core.errors import ConfigError, PerchError  # noqa: E402
from perch_core.registry import resolved  # noqa: E402
from perch_core.ros.arrival import ArrivalNode  # noqa: E402
from perch_core.ros.wiring import Wiring  # noqa: E402
from perch_core.values import CameraImage, PerchFeedback, PerchGoal, PerchResult, TargetPose  # noqa: E402
from perch_core.values.planning import PerchPlan, PerchPlanRequest  # noqa: E402
from perch_msgs.action import Perch  # noqa: E402
from perch_msgs.srv import PlanPerch  # noqa: E402
from perch_sim.lockstep.link import ParticipantListener, address, connect_to_vehicle, pack, unpack  # noqa: E402
from perch_sim.ros.participant_node import ParticipantNode  # noqa: E402
from perch_sim.ros.vehicle_node import BURST, RealTimeVehicleNode, VehicleNode  # noqa: E402
from perch_sim.simulated_vehicle import SimulatedVehicle  # noqa: E402
from perch_sim.vehicle_node import NODE  # noqa: E402
from rclpy.action import ActionClient  # noqa: E402
from rclpy.parameter import Parameter  # noqa: E402
from unit.test_requests_of_nodes import REQUEST, Nothing, until  # noqa: E402


class Asking(Component[Nothing]):
    """Asks, and keeps the answers."""

    config_type = Nothing
    plan_perch = Client(PerchPlanRequest, PerchPlan, "plan_perch")

    def __init__(self, config: Nothing) -> None:
        super().__init__(config)
        self.answers: list[str] = []

    def on_plan_perch(self, request, answer) -> None:
        """Keep it."""
        self.answers.append(answer.reason if isinstance(answer, Unavailable) else answer.message)


class Serving(Component[Nothing]):
    """Answers when the test does."""

    config_type = Nothing
    plan_perch = Service(PerchPlanRequest, PerchPlan, "plan_perch")

    def __init__(self, config: Nothing) -> None:
        super().__init__(config)
        self.replies: list = []

    def on_plan_perch(self, request, reply) -> None:
        """Later."""
        self.replies.append(reply)


def created(executor, host, kind, wiring=None, **parameters):
    """A node of a component."""
    given = [Parameter(name, value=value) for name, value in parameters.items()]
    one = host(kind.__name__.lower(), kind, wiring or Wiring(), context=executor.context, parameter_overrides=given)
    one.connect()
    executor.add_node(one)
    return one


def participant(executor, kind):
    """A node in lockstep whose batches the test begins."""
    wiring = Wiring()
    wiring.hosts_schedule = True
    return created(executor, ParticipantNode, kind, wiring)


def test_an_image_that_is_drawn_later_is_handed_to_neighbours_once_it_is_drawn(executor):
    wiring, seen, drawn = Wiring(), [], []
    wiring.add_reader("/camera_down/image_raw", seen.append)
    vehicle = created(executor, VehicleNode, SimulatedVehicle, wiring, cameras="none")
    image = CameraImage(1, "camera", 1, 1, "mono8", lambda _: np.zeros((1, 1), np.uint8), lambda timeout: bool(drawn))
    vehicle.component.image_down(image)
    vehicle._publish_rendered()
    assert not seen
    drawn.append(True)
    vehicle._publish_rendered()
    assert seen == [image]


def answered(executor, asking, replies, *messages):
    """The answers of the next batch, once as many requests have come as there are messages, which answer them in order."""
    results = []
    until(executor, lambda: len(replies) == len(messages))
    for reply, message in zip(replies, messages):
        reply(PerchPlan(success=False, error_code=2, message=message))
    asking.participant.begin(1, [])
    until(executor, lambda: results.append(asking.participant.results()) or results[-1] is not None)
    return asking.component.answers


def test_each_of_two_open_requests_gets_its_own_answer(executor):
    asking, replies = participant(executor, Asking), created(executor, ArrivalNode, Serving).component.replies
    for _ in range(2):
        asking.component.plan_perch(REQUEST, 0)
    assert answered(executor, asking, replies, "first", "second") == ["first", "second"]


def test_an_answer_that_comes_after_its_request_was_dropped_is_not_that_of_the_next_one(executor, monkeypatch):
    asking, replies = participant(executor, Asking), created(executor, ArrivalNode, Serving).component.replies
    asking.component.plan_perch(REQUEST, 0)
    until(executor, lambda: len(replies) == 1)
    with monkeypatch.context() as patched:  # the next one is not dropped
        patched.setattr("perch_core.ros.service_clients.ANSWER_TIMEOUT", -1.0)
        until(executor, asking._open_requests[0].answer.done)
    asking.component.plan_perch(REQUEST, 0)
    first, second = answered(executor, asking, replies, "late", "second")
    assert "has not answered" in first and second == "second"


def test_a_server_that_does_not_answer_is_named_once_and_in_the_diagnostics_until_it_answers(executor, monkeypatch):
    asking, replies = participant(executor, Asking), created(executor, ArrivalNode, Serving).component.replies
    warned = []
    monkeypatch.setattr(asking, "get_logger", lambda: SimpleNamespace(warning=warned.append))
    asking.component.plan_perch(REQUEST, 0)
    until(executor, lambda: len(replies) == 1)
    asking._check_requests()
    assert not warned and not asking.host_diagnostics()
    monkeypatch.setattr("perch_sim.ros.participant_node.WARN_AFTER", -1.0)
    asking._check_requests(), asking._check_requests()
    assert warned == ["no plan_perch from serving for -1 s"]
    assert asking.host_diagnostics() == {"waiting_for": "plan_perch from serving"}
    assert answered(executor, asking, replies, "late") == ["late"]
    assert not asking.host_diagnostics()


def test_a_vehicle_names_the_participants_that_do_not_connect(executor, monkeypatch):
    vehicle = created(executor, VehicleNode, SimulatedVehicle, cameras="none", participants=["estimator", "controller"])
    warned = []
    monkeypatch.setattr(vehicle, "get_logger", lambda: SimpleNamespace(warning=warned.append))
    vehicle._check_start(vehicle._created_at + 2.9)
    assert not warned
    for waited in (3.1, 4.0, 14.0):
        vehicle._check_start(vehicle._created_at + waited)
    assert warned == [f"lockstep: for {waited} s waiting for estimator, controller to connect" for waited in (3, 14)]


@pytest.fixture
def vehicle(executor, monkeypatch):
    """A vehicle that waits for two participants, what it logs, and how a process connects to it."""
    made, logged, clients = created(executor, VehicleNode, SimulatedVehicle, cameras="none", participants=["estimator", "controller"]), [], []
    monkeypatch.setattr(made, "get_logger", lambda: SimpleNamespace(**dict.fromkeys(("info", "warning", "error"), logged.append)))

    def connect(name):
        clients.append(connect_to_vehicle(address(os.environ.get("ROS_DOMAIN_ID", "0"), "/"), name, frozenset({"imu/data_raw"})))
        made._accept_participants()
        return clients[-1]

    yield made, logged, connect
    for client in clients:
        client.close()


def test_while_a_participant_is_connected_no_other_takes_its_place(vehicle):
    made, logged, connect = vehicle
    first, second = connect("controller"), connect("controller")
    assert second.poll(1.0) and not first.poll(0.0) and made._missing() == ["estimator"]
    with pytest.raises(EOFError):
        second.recv_bytes()
    assert logged == ["lockstep: another 'controller' tried to connect: ignored; end the process that is connected first"]
    made.wiring.participants["estimator"] = None  # of this process
    assert connect("estimator").poll(1.0)


def test_a_participant_that_ends_before_the_start_is_missing_again(vehicle):
    made, logged, connect = vehicle
    connect("controller").close()
    made._receive(1.0)
    assert logged == ["lockstep: controller has disconnected"] and made._missing() == ["estimator", "controller"]
    connect("controller")
    assert made._missing() == ["estimator"]


def test_a_participant_that_answers_with_no_batch_is_disconnected_and_the_log_says_why(vehicle):
    made, logged, connect = vehicle
    connect("controller").send_bytes(b"nonsense")
    made._receive(1.0)
    assert len(logged) == 1 and logged[0].startswith("lockstep: controller is disconnected: lockstep: 8 bytes are not a batch")


def test_every_command_of_a_node_outside_the_lockstep_is_warned_of(vehicle, monkeypatch):
    made, logged, _ = vehicle
    monkeypatch.setattr("perch_sim.ros.vehicle_node.foreign_publishers", lambda node, topic, known: ["/stranger"])
    made._warn_foreign_publishers()
    assert [line.split(":")[0] for line in logged] == ["attitude_thrust_command", "motor_command", "rates_thrust_command"]


def test_a_participant_that_there_is_not_is_refused(executor):
    with pytest.raises(ConfigError, match="participants: 'controler' is not one of estimator, controller, vio"):
        created(executor, VehicleNode, SimulatedVehicle, cameras="none", participants=["controler"])


def test_a_vehicle_that_fails_in_a_step_says_so_once_and_why(executor, monkeypatch):
    vehicle = created(executor, VehicleNode, SimulatedVehicle, cameras="none", participants=[""])
    calls, errors, reported = [], [], []

    def advance():
        calls.append(1)
        raise PerchError("the state is not finite")

    monkeypatch.setattr(vehicle.component, "advance", advance)
    monkeypatch.setattr(vehicle, "get_logger", lambda: SimpleNamespace(info=lambda _: None, warning=errors.append, error=errors.append))
    monkeypatch.setattr(vehicle, "_diagnostics", SimpleNamespace(publish=lambda message: reported.append(message.status[0])))
    until(executor, lambda: calls)
    vehicle._advance()
    vehicle._supervise()
    vehicle._diagnose()
    assert len(calls) == 1 and len(errors) == 1 and "the state is not finite" in errors[0]
    values = {pair.key: pair.value for pair in reported[-1].values}
    assert reported[-1].level == DiagnosticStatus.ERROR
    assert values["waiting_for"] == "a new start, as the simulation has failed: PerchError: the state is not finite"


def test_a_burst_does_not_look_for_messages_again_right_after_it_has_received_some(vehicle, monkeypatch):
    made, _, _ = vehicle
    completed, looks = itertools.cycle([False, True]), []
    monkeypatch.setattr(made, "_schedule", SimpleNamespace(names=["controller"], advance=lambda: next(completed), await_image=lambda timeout: False,
                                                           pending=lambda: [SimpleNamespace(name="controller")]))
    monkeypatch.setattr(made, "_remote", {"controller": None})
    monkeypatch.setattr(made, "_receive", lambda timeout: looks.append(timeout > 0.0) or timeout > 0.0)
    monkeypatch.setattr(made, "_advance_queued", True)
    made._burst()
    assert looks == [False, True] * (BURST // 2)


def test_a_participant_without_a_vehicle_says_so(executor, monkeypatch):
    monkeypatch.setattr("perch_sim.ros.participant_node.WARN_AFTER", -1.0)
    warned = []
    monkeypatch.setattr(Asking, "warn", lambda self, text, interval: warned.append(text))
    created(executor, ParticipantNode, Asking)
    assert warned == ["lockstep: no vehicle yet in namespace / for 0 s"]


def test_a_participant_that_is_not_served_says_so(executor):
    listener, said = ParticipantListener(address(os.environ.get("ROS_DOMAIN_ID", "0"), "/")), []
    refused = created(executor, ParticipantNode, Asking)
    refused.component.log.receivers.append(lambda line: said.append(line.text))
    try:
        refused.wiring.run_on(executor)
        [(_, _, connection)] = listener.accept()
        connection.close()
        until(executor, lambda: said)
        assert said[0].startswith("lockstep: the vehicle in namespace / closed the connection before the first step")
    finally:
        listener.close()


class Failing(Component[Nothing]):
    """Fails on whatever it is asked for."""

    config_type = Nothing
    plan_perch = Service(PerchPlanRequest, PerchPlan, "plan_perch")
    perch = Action(PerchGoal, PerchFeedback, PerchResult, "perch")

    def on_plan_perch(self, request, reply) -> None:
        """A defect."""
        raise ZeroDivisionError("no request is foreseen")

    def on_perch(self, goal) -> str:
        """A defect."""
        raise ZeroDivisionError("no goal is foreseen")


def test_a_participant_that_waits_for_its_first_goal_notices_that_the_vehicle_has_ended(executor):
    listener = ParticipantListener(address(os.environ.get("ROS_DOMAIN_ID", "0"), "/"))
    waiting = created(executor, ParticipantNode, Failing, lockstep_hold="perch")
    try:
        waiting.wiring.run_on(executor)
        [(_, _, connection)] = listener.accept()
        connection.send_bytes(pack(1, []))
        until(executor, lambda: waiting._busy)
        connection.close()
        until(executor, lambda: listener.accept())
    finally:
        listener.close()


class Drawing(Component[Nothing]):
    """Has a picture for people, and what participants take."""

    config_type = Nothing
    debug_image, target = Output(CameraImage, "vio/debug_image"), Output(TargetPose, "target/pose")


def test_pictures_for_people_are_not_drawn_for_a_vehicle_in_another_process(executor):
    drawing = created(executor, ParticipantNode, Drawing).component
    assert drawing.target.has_receivers and not drawing.debug_image.has_receivers


def test_a_second_vehicle_in_a_ros_domain_and_namespace_is_refused(executor):
    """In real time, too: two would send samples and images by turns."""
    where = address(os.environ.get("ROS_DOMAIN_ID", "0"), "/")
    first = created(executor, resolved(NODE.real_time), Drawing)
    with pytest.raises(PerchError, match="another vehicle runs in this ROS domain and namespace"):
        created(executor, RealTimeVehicleNode, Drawing)
    with pytest.raises(PerchError, match="another vehicle runs in this ROS domain and namespace"):
        ParticipantListener(where)
    first.close()
    ParticipantListener(where).close()


def test_a_value_without_a_message_ends_no_process(executor, monkeypatch):
    listener, refused = ParticipantListener(address(os.environ.get("ROS_DOMAIN_ID", "0"), "/")), []
    drawing = created(executor, ParticipantNode, Drawing)
    monkeypatch.setattr(drawing, "log_refusal", lambda name, error: refused.append(name))
    try:
        drawing.wiring.run_on(executor)
        [(_, _, connection)] = listener.accept()
        drawing.component.target("a defect")
        connection.send_bytes(pack(1, []))
        until(executor, lambda: connection.poll(0.0))
        assert unpack(connection.recv_bytes(), None)[1] == [] and refused == ["target/pose"]
    finally:
        listener.close()


@pytest.mark.parametrize("make", [participant, lambda executor, kind: created(executor, ArrivalNode, kind)], ids=["lockstep", "arrival"])
def test_requests_and_goals_that_a_component_fails_on_are_answered(executor, make):
    node = make(executor, Failing)
    planner, mission = node.create_client(PlanPerch, "plan_perch"), ActionClient(node, Perch, "perch")
    until(executor, lambda: planner.service_is_ready() and mission.server_is_ready())

    def answer(future):
        until(executor, future.done)
        return future.result()

    refusal = answer(planner.call_async(PlanPerch.Request()))
    assert (refusal.success, refusal.message) == (False, "no request is foreseen")
    for _ in range(2):
        handle = answer(mission.send_goal_async(Perch.Goal()))
        assert handle.accepted and answer(handle.get_result_async()).result.message == "no goal is foreseen"


class Shaky(Asking):
    """Fails on its first answer and at every tick."""

    tick = Timer(0.1)

    def on_plan_perch(self, request, answer) -> None:
        """Keep it; a defect."""
        super().on_plan_perch(request, answer)
        if len(self.answers) == 1:
            raise ZeroDivisionError("no answer is foreseen")

    def on_tick(self, now: int) -> None:
        """A defect."""
        raise ZeroDivisionError("no tick is foreseen")


def test_a_batch_that_waited_and_fails_is_finished_with_the_answers_after(executor):
    shaky, service, results = participant(executor, Shaky), created(executor, ArrivalNode, Serving), []
    for _ in range(2):
        shaky.component.plan_perch(REQUEST, 0)
    shaky.participant.begin(1, [])
    assert shaky.participant.results() is None
    until(executor, lambda: len(service.component.replies) == 2)
    for reply, message in zip(service.component.replies, ("first", "second")):
        reply(PerchPlan(success=False, error_code=2, message=message))
    until(executor, lambda: results.append(shaky.participant.results()) or results[-1] is not None)
    assert results[-1] == [] and shaky.component.answers == ["first", "second"]
