"""Goals of the Perch action: their check, and their conversion to goals of the mission."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from perch_core import so3
from perch_core.errors import ConfigError
from perch_core.values import PerchGoal, limits
from perch_control.mission.missions import mission_class
from perch_control.mission.settings import MissionSettings
from perch_control.mission.values import Goal


def problem_with(goal: PerchGoal, settings: MissionSettings) -> str:
    """Return why a goal cannot be flown; empty: it can."""
    try:
        problem = mission_class(goal.mode).problem(goal, settings)
    except ConfigError as error:
        return str(error)
    if problem:
        return problem
    if goal.search_frame and goal.search_frame != "map":
        return f"search_frame: {goal.search_frame!r} is not 'map'"
    if problem := limits.problem(goal if goal.search_frame else
                                 replace(goal, search_position=(0.0, 0.0, 0.0), search_attitude=(0.0, 0.0, 0.0, 1.0))):
        return problem
    if goal.search_frame and goal.search_position[2] < 0.3:
        return f"search_position: height {goal.search_position[2]:g} m is below 0.3 m"
    return ""


def goal_of(goal: PerchGoal, settings: MissionSettings) -> Goal:
    """Return the mission's goal, with defaults filled in."""

    def given(value: float, default: float) -> float:
        return default if math.isnan(value) else value

    position = yaw = None
    if goal.search_frame:
        position = np.array(goal.search_position)
        yaw = float(so3.yaw_of(so3.quat_to_matrix(np.array(goal.search_attitude))))
    return Goal(
        takeoff_height=given(goal.takeoff_height, settings.takeoff_height),
        search_timeout=given(goal.search_timeout, settings.search_timeout),
        perch_point=np.array(goal.perch_point), perch_pitch=goal.perch_pitch, perception_aware=goal.perception_aware,
        search_position=position, search_yaw=yaw, inclination_hint=None if math.isnan(goal.inclination_hint) else goal.inclination_hint,
        replan=goal.replan, attempts=max(1, goal.attempts))
