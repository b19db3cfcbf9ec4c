"""Node `perching_planner`: the service answers with proved plans, typed errors, and a plan from a running one."""

from __future__ import annotations

import math

import numpy as np
import pytest
import rclpy
from perch_core import so3
from perch_core.errors import ConfigError
from perch_core.ros.conversions import to_point, to_pose, to_stamp, to_vector
from perch_core.ros.trajectories import from_message
from perch_core.surface import PerchSurface
from perch_msgs.msg import Trajectory
from perch_msgs.srv import PlanPerch
from perch_planner import perching_planner_node
from perch_planner.verifier import Requirements, verify
from rclpy.experimental import EventsExecutor
from rclpy.parameter import Parameter

WALL = PerchSurface.from_inclination(np.array([1.7, 0.0, 1.4]), math.radians(90.0))


@pytest.fixture
def service(ros_domain):
    """Calls the node's service through DDS."""
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=ros_domain)
    node = perching_planner_node.create(context=context)
    caller = rclpy.create_node("caller", context=context)
    executor = EventsExecutor(context=context)
    for member in (node, caller):
        executor.add_node(member)
    client = caller.create_client(PlanPerch, "plan_perch")

    def call(request: PlanPerch.Request) -> PlanPerch.Response:
        for _ in range(1000):
            if client.service_is_ready():
                break
            executor.spin_once(timeout_sec=0.02)
        future = client.call_async(request)
        for _ in range(3000):
            if future.done():
                return future.result()
            executor.spin_once(timeout_sec=0.02)
        raise AssertionError("the service did not answer")

    yield call
    for member in (caller, node):
        executor.remove_node(member)
        member.destroy_node()
    executor.shutdown()
    rclpy.shutdown(context=context)


def request(surface: PerchSurface = WALL, **changes) -> PlanPerch.Request:
    """A request with every option left to the node's parameters."""
    nan = float("nan")
    out = PlanPerch.Request(
        start_time=to_stamp(12.5), start_position=to_point([0.0, 0.0, 1.4]),
        target=to_pose(surface.p_WS, so3.quat_from_matrix(surface.R_WS)), impact_acceleration=nan, impact_speed_min=nan,
        impact_speed_max=nan, thrust_max=nan, thrust_min=nan)
    for key, value in changes.items():
        setattr(out, key, value)
    return out


def test_a_plan_comes_back_as_polynomials_with_certificates(service):
    response = service(request())
    assert response.success and response.error_code == PlanPerch.Response.OK
    trajectory = response.trajectory
    assert trajectory.header.frame_id == "map" and trajectory.header.stamp == to_stamp(12.5)
    assert trajectory.at_end == Trajectory.AT_END_CONTACT and trajectory.contact_time > 0.0
    assert all(c.holds for c in response.certificates) and response.iterations >= 1
    limits = {c.quantity: (c.lower_limit, c.upper_limit) for c in response.certificates}
    rest = np.zeros(3)
    need = Requirements(
        start=np.array([[0.0, 0.0, 1.4], rest, rest, rest]), start_yaw=(0.0, 0.0), waypoints=np.zeros((0, 3)), p_S=WALL.p_WS,
        s1=WALL.R_WS[:, 0], s2=WALL.R_WS[:, 1], s3=WALL.normal, v_S=rest, perch_offset=0.04, mass=0.25,
        impact_acceleration=3.3, impact_speed=(0.4, 0.6), tangential_speed=0.3, tube=(0.15, 0.01, 0.1, 0.33),
        thrust=limits["thrust"], body_rate=limits["body_rate"][1], speed=limits["speed"][1], height=limits["height"],
        extension=0.15)
    rows = [[list(s.x), list(s.y), list(s.z), list(s.yaw)] for s in trajectory.segments]
    assert verify([s.duration for s in trajectory.segments], rows, need, step=1e-3) == []


def test_options_of_a_request_replace_the_parameters(service):
    free, bounded = service(request()), service(request(thrust_max=3.8, objective=PlanPerch.Request.OBJECTIVE_JERK))
    thrust = {c.quantity: c for c in bounded.certificates}["thrust"]
    assert bounded.success and thrust.upper_limit == 3.8 and thrust.maximum <= 3.8
    assert {c.quantity: c for c in free.certificates}["thrust"].upper_limit > 3.8
    shortest = service(request(minimum_time=True))
    assert sum(s.duration for s in shortest.trajectory.segments) < sum(s.duration for s in free.trajectory.segments)


def test_waypoints_motion_and_a_moving_target_are_taken(service):
    response = service(request(
        start_velocity=to_vector([0.5, 0.1, 0.0]), start_yaw=0.3, waypoints=[to_point([0.6, 0.1, 1.3])],
        target_velocity=to_vector([0.3, 0.0, 0.0])))
    assert response.success
    flown = from_message(response.trajectory)
    first, end = flown.sample(0.0), flown.sample(flown.duration)
    assert first.v == pytest.approx([0.5, 0.1, 0.0]) and first.yaw == pytest.approx(0.3)
    assert flown.sample(float(flown.durations[0])).p == pytest.approx([0.6, 0.1, 1.3], abs=1e-9)
    assert end.p == pytest.approx(WALL.p_WS + [0.3 * flown.duration - 0.04, 0.0, 0.0], abs=1e-9)


def test_a_running_trajectory_is_replaced_from_a_future_point(service):
    first = service(request())
    moved = PerchSurface.from_inclination(np.array([1.75, 0.05, 1.4]), math.radians(85.0))
    second = service(request(moved, start_time=to_stamp(13.2), from_trajectory=True, current=first.trajectory))
    assert second.success, second.message
    before, after = from_message(first.trajectory).sample(0.7), from_message(second.trajectory).sample(0.0)
    for name in ("p", "v", "a", "j"):
        assert getattr(after, name) == pytest.approx(getattr(before, name), abs=1e-6)
    late = service(request(start_time=to_stamp(99.0), from_trajectory=True, current=first.trajectory))
    assert not late.success and late.error_code == PlanPerch.Response.BAD_INPUT and "outside" in late.message


@pytest.mark.parametrize("changes, code, words", [
    ({"start_position": to_point([float("nan"), 0.0, 1.0])}, PlanPerch.Response.BAD_INPUT, "start: p"),
    ({"target": to_pose(np.zeros(3), np.array([0.0, 0.0, 0.0, 2.0]))}, PlanPerch.Response.BAD_INPUT, "orientation"),
    ({"segment_times": [1.0, 2.0]}, PlanPerch.Response.BAD_INPUT, "segment_times"),
    ({"impact_acceleration": -1.0}, PlanPerch.Response.BAD_INPUT, "impact_acceleration"),
    ({"impact_speed_min": 2.0}, PlanPerch.Response.BAD_INPUT, "impact_speed"),
    ({"objective": 9}, PlanPerch.Response.BAD_INPUT, "objective"),
    ({"impact_acceleration": 40.0}, PlanPerch.Response.UNREACHABLE_TILT, "m alpha"),
    ({"thrust_max": 2.3}, PlanPerch.Response.THRUST_FLOOR, "hover"),
    ({"start_position": to_point([3.0, 0.0, 1.4])}, PlanPerch.Response.BOX, "surface"),
])
def test_bad_requests_are_answered_with_a_typed_error(service, changes, code, words):
    response = service(request(**changes))
    assert not response.success and response.error_code == code
    assert words in response.message and not response.trajectory.segments


def test_wrong_parameters_are_refused_at_the_start(ros_domain):
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=ros_domain)
    try:
        for name, value in (("thrust_reserve", 1.5), ("solver", "ooqp"), ("no_such_parameter", 1)):
            with pytest.raises(ConfigError, match=name):
                perching_planner_node.create(context=context, parameter_overrides=[Parameter(name, value=value)])
    finally:
        rclpy.shutdown(context=context)
