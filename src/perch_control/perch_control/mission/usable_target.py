"""Check whether a target is good enough to plan on."""

from __future__ import annotations

import math

import numpy as np

from perch_core import so3
from perch_control.mission.settings import MissionSettings
from perch_control.mission.values import Goal, Target

ATTITUDE_SIGMA_MAX = math.radians(5.0)      # of a target to plan on [rad]
INCLINATION_TOLERANCE = math.radians(15.0)  # difference from the goal's, beyond which it is another surface [rad]
_UP = np.array([0.0, 0.0, 1.0])


def unusable_reason(target: Target, goal: Goal, settings: MissionSettings) -> str:
    """Return why a target is too uncertain to plan on, or not the one of the goal; empty: it is usable.

    Args:
        target: as localised.
        goal: goal of the mission.
        settings: limits.
    """
    if target.position_sigma > settings.target_position_sigma:
        return f"position uncertain by {target.position_sigma:.3f} m"
    if target.attitude_sigma > ATTITUDE_SIGMA_MAX:
        return f"attitude uncertain by {math.degrees(target.attitude_sigma):.1f} deg"
    if goal.inclination_hint is not None:
        inclination = so3.angle_between(so3.quat_rotate(target.q_WS, _UP), _UP)
        if abs(inclination - goal.inclination_hint) > INCLINATION_TOLERANCE:
            return f"inclination {math.degrees(inclination):.0f} deg, expected {math.degrees(goal.inclination_hint):.0f} deg"
    return ""
