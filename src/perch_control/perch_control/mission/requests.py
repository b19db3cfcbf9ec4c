"""Conversions: the mission's queries to planner requests, planner answers to plans, and plans to orders."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from perch_core import so3
from perch_core.component import Unavailable
from perch_core.trajectory import FlatTrajectory, SampledTrajectory
from perch_core.values import AtEnd, PerchPlan, PerchPlanRequest, PowerlinePlan, PowerlinePlanRequest, TrajectoryOrder, limits, nanoseconds
from perch_control.admission import TrajectoryRefused, check_quaternions
from perch_control.mission.values import Plan, PlanQuery, Refusal

_ROUNDING = 1e-6  # of the times in an answer [s]


def perch_request(query: PlanQuery, thrust_ratio: float) -> PerchPlanRequest:
    """Return the request for a perch on a surface; `thrust_ratio`: as reported by the controller."""
    return PerchPlanRequest(
        start=nanoseconds(query.start_time), p=query.p, v=query.v, yaw=float(query.yaw), current=query.current,
        p_WS=query.target.p_WS, q_WS=query.target.q_WS, segment_times=() if query.duration is None else (float(query.duration),),
        thrust_ratio=thrust_ratio)


def powerline_request(query: PlanQuery) -> PowerlinePlanRequest:
    """Return the request for a perch on a powerline, or for the way out of one."""
    x, target = query.state, query.target
    request = PowerlinePlanRequest(
        start=nanoseconds(query.start_time), p=query.p, q=so3.quat_exp(np.array([0.0, 0.0, query.yaw])), v=query.v,
        lines=target.lines, target_line=target.line, perch_pose=query.perch_pose, perch_point=target.p_WS,
        perch_pitch=float(query.goal.perch_pitch), perception_aware=query.goal.perception_aware, with_recovery=True,
        recovery_only=query.recovery)
    return request if x is None else replace(request, q=x.q, w=x.w, rotor_thrust=tuple(x.rotor_thrust.tolist()))


def plan_answer(plan: PerchPlan | PowerlinePlan | Unavailable) -> Plan | Refusal:
    """Return a planner's answer as a plan or a refusal; what is invalid is refused."""
    if isinstance(plan, Unavailable):
        return Refusal(plan.reason)
    if not plan.success or plan.trajectory is None:
        return Refusal(plan.message or "no reason was given")
    trajectory = plan.trajectory
    order, duration = TrajectoryOrder(0, trajectory, AtEnd.CONTACT), trajectory.duration
    if isinstance(plan, PowerlinePlan):
        if plan.recovery_start < 0.0:  # a perch alone, which the planner offers where it finds no recovery
            return Refusal(plan.message)
        if isinstance(trajectory, FlatTrajectory):
            return Refusal("invalid plan: trajectory: polynomials, not states")
        order, duration = order._replace(at_end=plan.at_end, recovery_start=plan.recovery_start), plan.perch_time or plan.recovery_time
    if not 0.0 < duration <= trajectory.duration + _ROUNDING:
        return Refusal(f"invalid plan: perch after {duration:g} s, in a trajectory of {trajectory.duration:g} s")
    if problem := limits.problem(order):
        return Refusal(f"invalid plan: {problem}")
    if isinstance(trajectory, SampledTrajectory):
        try:
            check_quaternions(trajectory)
        except TrajectoryRefused as error:
            return Refusal(f"invalid plan: {error}")
    return Plan(trajectory, duration, AtEnd(order.at_end), order.recovery_start)


def flown_order(id: int, plan: Plan, contact_time: float) -> TrajectoryOrder:
    """Return a plan as an order; `contact_time`: how long the contact is awaited [s]."""
    return TrajectoryOrder.of(id, plan.trajectory, plan.at_end, contact_time, plan.recovery_start)
