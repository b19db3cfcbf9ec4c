"""The mission's queries as requests to the planners, their answers as the mission takes them, and plans as orders."""

from __future__ import annotations

from perch_core import so3
from perch_core.component import Unavailable
from perch_core.values import AtEnd, PerchPlan, PerchPlanRequest, PowerlinePlan, PowerlinePlanRequest, TrajectoryOrder, nanoseconds
from perch_control.mission.values import PlanAnswer, PlanQuery
from perch_control.reference import normalised


def perch_request(query: PlanQuery) -> PerchPlanRequest:
    """The request for a perch on a surface."""
    return PerchPlanRequest(
        start=nanoseconds(query.start_time), p=query.p, v=query.v, a=query.a, j=query.j, yaw=float(query.yaw), current=query.current,
        p_WS=query.target.p_WS, q_WS=query.target.q_WS, segment_times=() if query.duration is None else (float(query.duration),))


def powerline_request(query: PlanQuery) -> PowerlinePlanRequest:
    """The request for a perch on a cable, or for the way out of one."""
    x, target = query.state, query.target
    moving = {} if x is None else {"w": x.w, "rotor_thrust": tuple(x.rotor_thrust.tolist())}
    return PowerlinePlanRequest(
        start=nanoseconds(query.start_time), p=query.p, q=so3.quat_exp([0.0, 0.0, query.yaw]) if x is None else x.q, v=query.v,
        lines=target.lines, target_line=target.line, perch_pose=query.perch_pose, perch_point=target.p_WS,
        perch_pitch=float(query.goal.perch_pitch), perception_aware=query.goal.perception_aware, with_recovery=True,
        recovery_only=query.recovery, **moving)


def plan_answer(plan: PerchPlan | PowerlinePlan | Unavailable) -> PlanAnswer:
    """What a planner's answer means to the mission."""
    if isinstance(plan, Unavailable):
        return PlanAnswer(False, plan.reason)
    if not plan.success or plan.trajectory is None:
        return PlanAnswer(False, plan.message or "no reason was given")
    trajectory = plan.trajectory
    if isinstance(plan, PerchPlan):
        return PlanAnswer(True, plan.message, trajectory, trajectory.start_time, trajectory.duration)
    if plan.recovery_start < 0.0:  # a perch alone, which the planner offers where it finds no recovery
        return PlanAnswer(False, plan.message)
    at_end = AtEnd.RECOVER if plan.perch_time else AtEnd.HOLD  # a recovery alone ends in a hover
    return PlanAnswer(True, plan.message, trajectory, trajectory.start_time, plan.perch_time or plan.recovery_time, normalised(trajectory),
                      at_end, plan.recovery_start)


def flown_order(id: int, plan: PlanAnswer, contact_time: float) -> TrajectoryOrder:
    """A plan as it is ordered; `contact_time`: how long the contact is awaited [s]."""
    return TrajectoryOrder.of(id, plan.trajectory, plan.at_end, contact_time, plan.recovery_start)
