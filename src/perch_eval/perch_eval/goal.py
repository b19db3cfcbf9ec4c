"""The mission goal of a scenario, and the possible outcomes of a flight."""

from __future__ import annotations

import math

from perch_control.mission.values import Mode, Result
from perch_core.values import PerchGoal
from perch_sim.scenario import Scenario

OUTCOMES = {int(result): result.name.lower() for result in Result}
"""Error code of the Perch action's result -> outcome."""
SUCCESSES = ("perched", "inspected")
"""Outcomes of a successful flight."""


def goal_of(scenario: Scenario) -> PerchGoal:
    """Return the goal that a scenario's mission section describes."""
    mission = scenario.mission
    points = {"powerline": mission.perch_point, "inspection": scenario.inspection.watched}
    return PerchGoal(
        mode=int(Mode[scenario.mode.upper()]), takeoff_height=mission.takeoff_height, search_timeout=mission.search_timeout,
        perch_point=tuple(points.get(scenario.mode, (0.0, 0.0, 0.0))), perch_pitch=math.radians(mission.perch_pitch_deg),
        perception_aware=mission.perception_aware, replan=mission.replan, attempts=mission.attempts)


def outcome_of(error_code: int, scenario: Scenario) -> str:
    """Return the outcome of a goal from the error code of its result."""
    outcome = OUTCOMES.get(error_code, "failed")
    return "inspected" if outcome == "perched" and scenario.mode == "inspection" else outcome
