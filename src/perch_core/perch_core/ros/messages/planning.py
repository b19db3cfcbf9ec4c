"""Conversions of requests to the planners and their answers."""

from __future__ import annotations

import math

import numpy as np
from geometry_msgs.msg import Point, Pose, Vector3
from perch_core.ros.messages.basic import floats, quaternion_floats, stamp_value, to_point, to_pose, to_stamp, to_vector
from perch_core.ros.messages.flight import trajectory_message, trajectory_value
from perch_core.ros.messages.perching import powerline_message, powerline_value
from perch_core.values import Certificate, PerchPlan, PerchPlanRequest, PowerlinePlan, PowerlinePlanRequest
from perch_core.values.planning import OPTIONS
from perch_msgs.msg import Certificate as CertificateMessage
from perch_msgs.srv import PlanPerch, PlanPowerline


def _array(v: Vector3 | Point) -> np.ndarray:
    return np.array(floats(v))


def _pose(pose: Pose) -> tuple[np.ndarray, np.ndarray]:
    return _array(pose.position), np.array(quaternion_floats(pose.orientation))


def certificate_message(c: Certificate) -> CertificateMessage:
    """Convert to `perch_msgs/Certificate`."""
    return CertificateMessage(
        quantity=c.quantity, unit=c.unit, lower_limit=float(c.lower_limit), upper_limit=float(c.upper_limit), minimum=float(c.minimum),
        maximum=float(c.maximum), time_of_minimum=float(c.time_of_minimum), time_of_maximum=float(c.time_of_maximum), method=c.method,
        holds=bool(c.holds))


def certificate_value(c: CertificateMessage) -> Certificate:
    """Convert from `perch_msgs/Certificate`."""
    return Certificate(
        quantity=c.quantity, unit=c.unit, lower_limit=c.lower_limit, upper_limit=c.upper_limit, minimum=c.minimum, maximum=c.maximum,
        time_of_minimum=c.time_of_minimum, time_of_maximum=c.time_of_maximum, method=c.method, holds=c.holds)


# -- perches on surfaces -----------------------------------------------------------------------------------------------


def perch_request_message(r: PerchPlanRequest) -> PlanPerch.Request:
    """Convert a request of `plan_perch` to its message."""
    msg = PlanPerch.Request(
        start_time=to_stamp(r.start), start_position=to_point(r.p), start_velocity=to_vector(r.v), start_acceleration=to_vector(r.a),
        start_jerk=to_vector(r.j), start_yaw=float(r.yaw), start_yaw_rate=float(r.yaw_rate), target=to_pose(r.p_WS, r.q_WS),
        target_velocity=to_vector(r.target_velocity), waypoints=[to_point(p) for p in r.waypoints],
        segment_times=[float(t) for t in r.segment_times], thrust_ratio=float(r.thrust_ratio), objective=int(r.objective),
        minimum_time=bool(r.minimum_time))
    for name in OPTIONS:
        value = getattr(r, name)
        setattr(msg, name, math.nan if value is None else float(value))
    if r.current is not None:
        msg.from_trajectory, msg.current = True, trajectory_message(r.current)
    return msg


def perch_request_value(msg: PlanPerch.Request) -> PerchPlanRequest:
    """Convert a request message of `plan_perch`; options that are NaN become None.

    Raises:
        PerchError: `current` is not a valid trajectory.
    """
    p_WS, q_WS = _pose(msg.target)
    options = {name: None if math.isnan(value := getattr(msg, name)) else value for name in OPTIONS}
    return PerchPlanRequest(
        start=stamp_value(msg.start_time), p=_array(msg.start_position), v=_array(msg.start_velocity), a=_array(msg.start_acceleration),
        j=_array(msg.start_jerk), yaw=msg.start_yaw, yaw_rate=msg.start_yaw_rate,
        current=trajectory_value(msg.current) if msg.from_trajectory else None, p_WS=p_WS, q_WS=q_WS,
        target_velocity=_array(msg.target_velocity), waypoints=np.array([floats(p) for p in msg.waypoints]).reshape(-1, 3),
        segment_times=tuple(msg.segment_times), thrust_ratio=msg.thrust_ratio, objective=msg.objective, minimum_time=msg.minimum_time,
        **options)


def perch_plan_message(plan: PerchPlan) -> PlanPerch.Response:
    """Convert an answer of `plan_perch` to its message."""
    msg = PlanPerch.Response(
        success=bool(plan.success), error_code=int(plan.error_code), message=plan.message,
        certificates=[certificate_message(c) for c in plan.certificates], iterations=int(plan.iterations), solve_time=float(plan.solve_time))
    if plan.trajectory is not None:
        msg.trajectory = trajectory_message(plan.trajectory)
        msg.trajectory.contact_time = float(plan.contact_time)
        msg.trajectory.at_end = msg.trajectory.AT_END_CONTACT if plan.contact_time else msg.trajectory.AT_END_HOLD
    return msg


def perch_plan_value(msg: PlanPerch.Response) -> PerchPlan:
    """Convert an answer message of `plan_perch`."""
    return PerchPlan(
        success=msg.success, error_code=msg.error_code, message=msg.message, trajectory=trajectory_value(msg.trajectory) if msg.success else None,
        contact_time=msg.trajectory.contact_time, certificates=tuple(certificate_value(c) for c in msg.certificates), iterations=msg.iterations,
        solve_time=msg.solve_time)


# -- perches on powerlines ---------------------------------------------------------------------------------------------


def powerline_request_message(r: PowerlinePlanRequest) -> PlanPowerline.Request:
    """Convert a request of `plan_powerline` to its message."""
    msg = PlanPowerline.Request(
        start_time=to_stamp(r.start), start_pose=to_pose(r.p, r.q), start_velocity=to_vector(r.v), start_angular_velocity=to_vector(r.w),
        start_rotor_thrust=[float(f) for f in r.rotor_thrust], lines=[powerline_message(line) for line in r.lines],
        target_line=int(r.target_line), perch_point=to_point(r.perch_point), perch_pitch=float(r.perch_pitch),
        end_velocity=to_vector(r.end_velocity), perception_aware=bool(r.perception_aware), with_recovery=bool(r.with_recovery),
        recovery_only=bool(r.recovery_only), deadline=float(r.deadline))
    if r.perch_pose is not None:
        msg.use_pose, msg.perch_pose = True, to_pose(*r.perch_pose)
    return msg


def powerline_request_value(msg: PlanPowerline.Request) -> PowerlinePlanRequest:
    """Convert a request message of `plan_powerline`."""
    p, q = _pose(msg.start_pose)
    return PowerlinePlanRequest(
        start=stamp_value(msg.start_time), p=p, q=q, v=_array(msg.start_velocity), w=_array(msg.start_angular_velocity),
        rotor_thrust=tuple(msg.start_rotor_thrust), lines=tuple(powerline_value(line) for line in msg.lines), target_line=msg.target_line,
        perch_pose=_pose(msg.perch_pose) if msg.use_pose else None, perch_point=_array(msg.perch_point), perch_pitch=msg.perch_pitch,
        end_velocity=_array(msg.end_velocity), perception_aware=msg.perception_aware, with_recovery=msg.with_recovery,
        recovery_only=msg.recovery_only, deadline=msg.deadline)


def powerline_plan_message(plan: PowerlinePlan) -> PlanPowerline.Response:
    """Convert an answer of `plan_powerline` to its message."""
    msg = PlanPowerline.Response(
        success=bool(plan.success), error_code=int(plan.error_code), message=plan.message,
        certificates=[certificate_message(c) for c in plan.certificates], perch_time=float(plan.perch_time),
        recovery_time=float(plan.recovery_time), solve_time=float(plan.solve_time), recovery_solve_time=float(plan.recovery_solve_time),
        iterations=int(plan.iterations), solver=plan.solver)
    if plan.trajectory is not None:
        msg.trajectory = trajectory_message(plan.trajectory)
        msg.trajectory.at_end, msg.trajectory.contact_time = int(plan.at_end), float(plan.contact_time)
        msg.trajectory.recovery_start = float(plan.recovery_start)
    return msg


def powerline_plan_value(msg: PlanPowerline.Response) -> PowerlinePlan:
    """Convert an answer message of `plan_powerline`."""
    t = msg.trajectory
    return PowerlinePlan(
        success=msg.success, error_code=msg.error_code, message=msg.message, trajectory=trajectory_value(t) if msg.success else None,
        at_end=t.at_end, contact_time=t.contact_time, recovery_start=t.recovery_start if msg.success else -1.0,
        certificates=tuple(certificate_value(c) for c in msg.certificates), perch_time=msg.perch_time, recovery_time=msg.recovery_time,
        solve_time=msg.solve_time, recovery_solve_time=msg.recovery_solve_time, iterations=msg.iterations, solver=msg.solver)
