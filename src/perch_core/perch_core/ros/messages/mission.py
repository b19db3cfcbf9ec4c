"""Conversions of goal, feedback and result of the Perch action."""

from __future__ import annotations

from perch_core.ros.messages.basic import floats, quaternion_floats, to_point, to_pose
from perch_core.values import PerchFeedback, PerchGoal, PerchResult
from perch_msgs.action import Perch


def goal_value(msg: Perch.Goal) -> PerchGoal:
    """Convert a goal message to the goal."""
    pose = msg.search_pose.pose
    return PerchGoal(
        mode=msg.mode, takeoff_height=msg.takeoff_height, search_frame=msg.search_pose.header.frame_id, search_position=floats(pose.position),
        search_attitude=quaternion_floats(pose.orientation), search_timeout=msg.search_timeout, inclination_hint=msg.inclination_hint,
        perch_point=floats(msg.perch_point), perch_pitch=msg.perch_pitch, perception_aware=msg.perception_aware, replan=msg.replan,
        attempts=msg.attempts)


def goal_message(goal: PerchGoal) -> Perch.Goal:
    """Convert a goal to its message, for clients."""
    msg = Perch.Goal(
        mode=int(goal.mode), takeoff_height=float(goal.takeoff_height), search_timeout=float(goal.search_timeout),
        inclination_hint=float(goal.inclination_hint), perch_point=to_point(goal.perch_point), perch_pitch=float(goal.perch_pitch),
        perception_aware=bool(goal.perception_aware), replan=bool(goal.replan), attempts=int(goal.attempts))
    msg.search_pose.header.frame_id, msg.search_pose.pose = goal.search_frame, to_pose(goal.search_position, goal.search_attitude)
    return msg


def feedback_message(feedback: PerchFeedback) -> Perch.Feedback:
    """Convert feedback to its message."""
    return Perch.Feedback(phase=feedback.phase, progress=float(feedback.progress), time_to_contact=float(feedback.time_to_contact),
                          message=feedback.message)


def rejected(reason: str) -> PerchResult:
    """Return the result of a rejected goal, with the reason as its message."""
    return PerchResult(False, Perch.Result.BAD_GOAL, reason)


def result_message(result: PerchResult) -> Perch.Result:
    """Convert a result to its message."""
    return Perch.Result(
        success=bool(result.success), error_code=int(result.error_code), message=result.message, contact_time=float(result.contact_time),
        end_time=float(result.end_time), final_pose=to_pose(result.final_position, result.final_attitude))
