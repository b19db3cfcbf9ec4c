"""The mission goal of a scenario, and the possible outcomes of a flight."""

from __future__ import annotations

import math

from perch_control.mission.missions import mode_of
from perch_control.mission.values import Result
from perch_core.values import PerchGoal
from perch_sim.scenario import Scenario

OUTCOMES = {int(result): result.name.lower() for result in Result}
"""Error code of the Perch action's result -> outcome."""
SUCCESSES = ("perched", "inspected")
"""Outcomes of a successful flight."""


def goal_of(scenario: Scenario) -> PerchGoal:
    """Return the goal that a scenario's mission section describes.

    Raises:
        ConfigError: there is no such mission.
    """
    mission = scenario.mission
    point = scenario.inspection.watched if scenario.mode == "inspection" else mission.perch_point
    return PerchGoal(
        mode=mode_of(scenario.mission_type), takeoff_height=mission.takeoff_height, search_timeout=mission.search_timeout,
        perch_point=tuple(point), perch_pitch=math.radians(mission.perch_pitch_deg),
        perception_aware=mission.perception_aware, replan=mission.replan, attempts=mission.attempts)


def outcome_of(error_code: int, scenario: Scenario, timed_out: bool = False) -> str:
    """Return the outcome of a goal from the error code of its result; `timed_out`: it was cancelled at the scenario's time limit."""
    outcome = OUTCOMES.get(error_code, "failed")
    if outcome == "perched" and scenario.mode == "inspection":
        return "inspected"
    return "timeout" if outcome == "cancelled" and timed_out else outcome
