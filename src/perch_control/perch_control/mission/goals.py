"""The Perch action's goal: whether it can be flown, and what it means."""

from __future__ import annotations

import math

import numpy as np

from perch_core import so3
from perch_core.values import PerchGoal
from perch_control.mission.missions import MISSIONS, known_modes, mission_class
from perch_control.mission.settings import MissionSettings
from perch_control.mission.values import Goal

_FARTHEST = 1e4  # [m]


def problem_with(goal: PerchGoal, settings: MissionSettings) -> str:
    """Why a goal cannot be flown; empty: it can."""
    if goal.mode not in MISSIONS:
        return f"mode {goal.mode} is none of {known_modes()}"
    problem = mission_class(goal.mode).problem(goal, settings)
    if problem:
        return problem
    if not math.isnan(goal.takeoff_height) and not 0.3 <= goal.takeoff_height <= 10.0:
        return f"takeoff_height {goal.takeoff_height:g} m is outside [0.3, 10]"
    if not math.isnan(goal.search_timeout) and not 0.0 < goal.search_timeout <= 300.0:
        return f"search_timeout {goal.search_timeout:g} s is outside (0, 300]"
    if not math.isnan(goal.inclination_hint) and not 0.0 <= goal.inclination_hint <= math.pi:
        return f"inclination_hint {goal.inclination_hint:g} rad is outside [0, pi]"
    if goal.search_frame not in ("", "map"):
        return f"search_pose: frame_id {goal.search_frame!r} is not 'map'"
    if goal.search_frame:
        p, q = np.array(goal.search_position), np.array(goal.search_attitude)
        if not np.abs(p).max() < _FARTHEST or not abs(np.linalg.norm(q) - 1.0) <= 1e-3:
            return "search_pose: position is not finite, or the quaternion is not of norm 1"
        if p[2] < 0.3:
            return f"search_pose: height {p[2]:g} m is below 0.3 m"
    return ""


def goal_of(goal: PerchGoal, settings: MissionSettings) -> Goal:
    """The goal with its defaults filled in."""

    def given(value: float, default: float) -> float:
        return default if math.isnan(value) else value

    position = yaw = None
    if goal.search_frame:
        position = np.array(goal.search_position)
        yaw = float(so3.yaw_of(so3.quat_to_matrix(np.array(goal.search_attitude))))
    return Goal(
        takeoff_height=given(goal.takeoff_height, settings.takeoff_height),
        search_timeout=given(goal.search_timeout, settings.search_timeout), mode=goal.mode, perch_point=np.array(goal.perch_point), perch_pitch=goal.perch_pitch, perception_aware=goal.perception_aware,
        search_position=position, search_yaw=yaw, inclination_hint=None if math.isnan(goal.inclination_hint) else goal.inclination_hint,
        replan=goal.replan, attempts=max(1, goal.attempts))
