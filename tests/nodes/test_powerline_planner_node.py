"""Node `powerline_planner`: plans and typed refusals over its service, in one node that every test shares."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np
import pytest
import rclpy
from geometry_msgs.msg import Point, Pose, Quaternion
from perch_msgs.msg import Powerline, Trajectory
from perch_msgs.srv import PlanPowerline
from rclpy.experimental import EventsExecutor

from perch_core.errors import ConfigError
from perch_core.ros.conversions import to_point, to_stamp
from perch_core.ros.trajectories import from_message
from perch_eval.domain import reserved_domain
from perch_planner import powerline_planner_node
from perch_planner.powerline import problem
from rclpy.parameter import Parameter

LINES = problem.load("powerline_line_80").segments()
OK, R = PlanPowerline.Response.OK, PlanPowerline.Response
Ask = Callable[[PlanPowerline.Request], PlanPowerline.Response]


def line_messages() -> list[Powerline]:
    return [Powerline(id=10 + line.id, start=to_point(line.ends[0]), end=to_point(line.ends[1]), radius=line.radius)
            for line in LINES]


def a_request(**changes) -> PlanPowerline.Request:
    """The 80 deg perch, changed."""
    fields = dict(
        start_time=to_stamp(12.5), start_pose=Pose(position=Point(x=0.0, y=0.0, z=4.3), orientation=Quaternion(w=1.0)),
        lines=line_messages(), target_line=10, perch_point=to_point(LINES[0].centre), perch_pitch=math.radians(80.0),
        with_recovery=True, deadline=30.0)
    return PlanPowerline.Request(**{**fields, **changes})


@pytest.fixture(scope="module")
def ask() -> Iterator[Ask]:
    with reserved_domain() as domain:
        context = rclpy.Context()
        rclpy.init(context=context, domain_id=domain)
        executor = EventsExecutor(context=context)
        node = powerline_planner_node.create(context=context)
        caller = rclpy.create_node("caller", context=context)
        client = caller.create_client(PlanPowerline, "plan_powerline")
        executor.add_node(node), executor.add_node(caller)

        def call(request: PlanPowerline.Request) -> PlanPowerline.Response:
            future = client.call_async(request)
            executor.spin_until_future_complete(future, timeout_sec=120.0)
            return future.result()

        assert client.wait_for_service(timeout_sec=60.0)
        yield call
        executor.remove_node(node), executor.remove_node(caller)
        node.destroy_node(), caller.destroy_node()
        rclpy.shutdown(context=context)


def test_a_perch_with_recovery_is_one_trajectory_with_certificates(ask: Ask) -> None:
    answer = ask(a_request())
    assert answer.success and answer.error_code == OK, answer.message
    trajectory = from_message(answer.trajectory)
    assert trajectory.start_time == pytest.approx(12.5)
    assert answer.trajectory.at_end == Trajectory.AT_END_RECOVER
    assert answer.trajectory.recovery_start == pytest.approx(answer.perch_time)
    assert trajectory.duration == pytest.approx(answer.perch_time + answer.recovery_time)
    # At the joint the gripper, 0.15 m below the centre of mass, is 2.5 cm short of the line.
    joint = int(np.argmin(np.abs(trajectory.times - answer.perch_time)))
    assert trajectory.times[joint] == pytest.approx(answer.perch_time, abs=1e-9)
    assert LINES[0].distance(trajectory.p[joint]) == pytest.approx(0.175, abs=1e-3)
    np.testing.assert_allclose(trajectory.v[-1], 0, atol=0.02)
    assert {c.quantity for c in answer.certificates} >= {"clearance", "height", "thrust", "thrust_rate", "body_rate",
                                                         "recovery_clearance", "recovery_height"}
    assert all(c.holds for c in answer.certificates)
    assert answer.solver == "fatrop" and answer.iterations > 0 and answer.solve_time > 0


def test_a_full_pose_and_no_recovery(ask: Ask) -> None:
    pose = Pose(position=to_point(LINES[1].centre - [0, 0, 0.15]), orientation=Quaternion(x=1.0, w=0.0))
    answer = ask(a_request(use_pose=True, perch_pose=pose, target_line=11, with_recovery=False))
    assert answer.success, answer.message
    assert answer.trajectory.at_end == Trajectory.AT_END_CONTACT
    assert answer.trajectory.recovery_start < 0
    end = answer.trajectory.points[-1].pose.position
    np.testing.assert_allclose([end.x, end.y, end.z], LINES[1].centre - [0, 0, 0.15], atol=1e-3)


def test_a_recovery_alone_starts_from_the_given_state(ask: Ask) -> None:
    tilted = Pose(position=Point(x=3.0, y=0.0, z=4.3),
                  orientation=Quaternion(y=-math.sin(math.radians(40)), w=math.cos(math.radians(40))))
    request = a_request(start_pose=tilted, recovery_only=True)
    request.start_velocity.x = 1.0
    answer = ask(request)
    assert answer.success, answer.message
    assert answer.trajectory.at_end == Trajectory.AT_END_HOLD
    first, last = answer.trajectory.points[0], answer.trajectory.points[-1]
    assert first.linear_velocity.x == pytest.approx(1.0)
    assert abs(last.linear_velocity.x) < 0.02 and last.pose.orientation.w**2 + last.pose.orientation.z**2 > 0.99999


def crossing() -> list[Powerline]:
    return [*line_messages(), Powerline(id=20, start=Point(x=3.0, y=0.0, z=4.2), end=Point(x=6.0, y=0.0, z=4.2), radius=0.03)]


@pytest.mark.parametrize(("changes", "code", "words"), [
    (dict(lines=[]), R.EMPTY_MAP, "not in the map"),
    (dict(target_line=3), R.EMPTY_MAP, "target line 3"),
    (dict(lines=crossing()), R.BAD_INPUT, "lines 10 and 20 cross"),
    (dict(perch_pitch=4.0), R.BAD_INPUT, "pitch"),
    (dict(perch_pitch=math.nan), R.BAD_INPUT, "pitch"),
    (dict(perch_point=Point(x=math.nan)), R.BAD_INPUT, "perch point"),
    (dict(start_pose=Pose(position=Point(z=math.inf), orientation=Quaternion(w=1.0))), R.BAD_INPUT, "start state"),
    (dict(start_pose=Pose(position=Point(z=4.3), orientation=Quaternion(w=0.5))), R.BAD_INPUT, "norm 0.5"),
    (dict(start_pose=Pose(position=Point(z=0.5), orientation=Quaternion(w=1.0))), R.START_INVALID, "below height_min"),
    (dict(start_pose=Pose(position=Point(x=4.0, z=4.25), orientation=Quaternion(w=1.0))), R.START_INVALID, "nearer than the body"),
    (dict(start_pose=Pose(position=Point(z=4.3), orientation=Quaternion(z=1.0, w=0.0))), R.BAD_INPUT, "behind the vehicle"),
    (dict(start_rotor_thrust=[1.0, 2.0]), R.BAD_INPUT, "2 values"),
    (dict(use_pose=True, perch_pose=Pose(position=to_point(LINES[0].centre), orientation=Quaternion(w=1.0))),
     R.PERCH_IN_COLLISION, "cuts line 10"),
    (dict(use_pose=True, perch_pose=Pose(position=Point(x=4.0, z=5.2), orientation=Quaternion(w=1.0))), R.BAD_INPUT, "gripper"),
    (dict(deadline=1e-4), R.DEADLINE, "0.0001 s"),
    (dict(deadline=-1.0), R.BAD_INPUT, "deadline"),
])
def test_what_cannot_be_planned_is_refused_by_cause(ask: Ask, changes: dict, code: int, words: str) -> None:
    answer = ask(a_request(**changes))
    assert not answer.success
    assert (answer.error_code, words in answer.message) == (code, True), answer.message
    assert not answer.trajectory.points


@pytest.mark.parametrize(("name", "value", "words"), [
    ("height_min", float("nan"), "nan"), ("solver", "snopt", "fatrop"), ("camera", "rear", "no camera"),
    ("vehicle", "snapdragon", "thrust_rate_max"), ("margins.heigth", 0.1, "unknown parameter"),
])
def test_parameters_that_cannot_be_are_refused_at_the_start(ros_domain: int, name: str, value: object, words: str) -> None:
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=ros_domain)
    try:
        with pytest.raises(ConfigError, match=words):
            powerline_planner_node.create(context=context, parameter_overrides=[Parameter(name, value=value)])
    finally:
        rclpy.shutdown(context=context)


def test_the_node_goes_on_while_it_plans_and_answers_in_order() -> None:
    with reserved_domain() as domain:
        context = rclpy.Context()
        rclpy.init(context=context, domain_id=domain)
        executor = EventsExecutor(context=context)
        node = powerline_planner_node.create(context=context)
        caller = rclpy.create_node("caller", context=context)
        client = caller.create_client(PlanPowerline, "plan_powerline")
        executor.add_node(node), executor.add_node(caller)
        assert client.wait_for_service(timeout_sec=60.0)
        events: list[str] = []
        node.create_timer(0.005, lambda: events.append("tick"))
        futures = [client.call_async(a_request(perch_pitch=math.radians(pitch))) for pitch in (80.0, 60.0)]
        for number, future in enumerate(futures):
            future.add_done_callback(lambda _, number=number: events.append(f"plan {number}"))
        executor.spin_until_future_complete(futures[1], timeout_sec=120.0)
        assert all(future.result().success for future in futures)
        assert events.index("tick") < events.index("plan 0") < events.index("plan 1")
        client.call_async(a_request(deadline=60.0))
        executor.spin_once(timeout_sec=1.0)  # the node is destroyed in the middle of a solve
        process = node._worker._process
        executor.remove_node(node), executor.remove_node(caller)
        node.destroy_node(), caller.destroy_node()
        assert process.poll() is not None and not node._thread.is_alive()
        rclpy.shutdown(context=context)
