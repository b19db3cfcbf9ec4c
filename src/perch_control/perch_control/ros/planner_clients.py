"""The mission's clients of both planning services: queries to requests, responses to answers."""

from __future__ import annotations

from typing import Any

from perch_msgs.msg import Trajectory
from perch_msgs.srv import PlanPerch, PlanPowerline
from rclpy.node import Node
from rclpy.task import Future

from perch_core import so3
from perch_core.ros.conversions import to_point, to_pose, to_seconds, to_stamp, to_vector
from perch_core.ros.trajectories import from_message, sampled_message
from perch_control.mission import Mode, PlanAnswer, PlanQuery

_NAN = float("nan")


class PlannerClients:
    """Asks `plan_perch` for surfaces and `plan_powerline` for cables."""

    def __init__(self, node: Node) -> None:
        self._clients = {Mode.SURFACE: node.create_client(PlanPerch, "plan_perch"),
                         Mode.POWERLINE: node.create_client(PlanPowerline, "plan_powerline")}

    def ask(self, query: PlanQuery) -> Future:
        """Send a query. A planner that is not there is a failed answer, not a wait."""
        client = self._clients[query.goal.mode]
        if not client.service_is_ready():
            missing = Future()
            missing.set_result(client.srv_type.Response(success=False, message=f"service {client.srv_name} is not there"))
            return missing
        return client.call_async(_surface(query) if query.goal.mode is Mode.SURFACE else powerline_request(query))

    @staticmethod
    def answer(future: Future) -> PlanAnswer:
        """The answer that a finished future holds."""
        response: Any = future.result()
        if response is None:
            return PlanAnswer(False, f"the planner failed: {future.exception()}")
        return plan_answer(response)


def plan_answer(response: PlanPerch.Response | PlanPowerline.Response) -> PlanAnswer:
    """What a planner's response means to the mission."""
    trajectory = response.trajectory
    sampled = None
    if isinstance(response, PlanPowerline.Response):
        duration = response.perch_time or response.recovery_time
        if response.perch_time:  # a recovery alone ends in a hover
            trajectory.at_end = Trajectory.AT_END_RECOVER
        if response.success:
            sampled = from_message(trajectory)
    else:
        trajectory.at_end, duration = Trajectory.AT_END_CONTACT, sum(s.duration for s in trajectory.segments)
    return PlanAnswer(response.success, response.message, trajectory, to_seconds(trajectory.header.stamp), duration, sampled)


def perch_message(plan: PlanAnswer) -> Trajectory:
    """The trajectory of a plan as it is published: the planner's own, or one made from the states of a plan that was moved."""
    if plan.trajectory is not None:
        return plan.trajectory
    msg = sampled_message(plan.sampled)
    msg.at_end, msg.recovery_start = Trajectory.AT_END_RECOVER, float(plan.duration)
    return msg


def _surface(query: PlanQuery) -> PlanPerch.Request:
    request = PlanPerch.Request(
        start_time=to_stamp(float(query.start_time)), start_position=to_point(query.p),
        start_velocity=to_vector(query.v), start_acceleration=to_vector(query.a), start_jerk=to_vector(query.j),
        start_yaw=float(query.yaw), target=to_pose(query.target.p_WS, query.target.q_WS),
        impact_acceleration=_NAN, impact_speed_min=_NAN, impact_speed_max=_NAN, thrust_max=_NAN, thrust_min=_NAN)
    if query.current is not None:
        request.from_trajectory, request.current = True, query.current
    if query.duration is not None:
        request.segment_times = [float(query.duration)]
    return request


def powerline_request(query: PlanQuery) -> PlanPowerline.Request:
    """The request for a perch on a cable, or for the way out of one."""
    q_WB = so3.quat_exp([0.0, 0.0, query.yaw]) if query.state is None else query.state.q
    request = PlanPowerline.Request(
        start_time=to_stamp(float(query.start_time)), start_pose=to_pose(query.p, q_WB), start_velocity=to_vector(query.v),
        target_line=query.target.line, perch_point=to_point(query.target.p_WS), perch_pitch=float(query.goal.perch_pitch),
        perception_aware=query.goal.perception_aware, with_recovery=True, recovery_only=query.recovery)
    if query.state is not None:
        request.start_angular_velocity = to_vector(query.state.w)
        request.start_rotor_thrust = query.state.rotor_thrust.tolist()
    if query.perch_pose is not None:
        request.use_pose, request.perch_pose = True, to_pose(*query.perch_pose)
    request.lines = list(query.target.lines)
    return request
