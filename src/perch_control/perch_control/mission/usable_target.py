"""Whether a target is good enough to plan on."""

from __future__ import annotations

import math

import numpy as np

from perch_core import so3
from perch_control.mission.settings import MissionSettings
from perch_control.mission.values import Goal, Target

_UP = np.array([0.0, 0.0, 1.0])


def usable(target: Target | None, since: float, goal: Goal, settings: MissionSettings, unseen: str = "no tags seen") -> tuple[bool, str]:
    """Whether a target is fresh and certain enough to plan on, and why not.

    Args:
        target: as localised, None: not seen.
        since: older sightings do not count [s].
        goal: what was asked for.
        settings: limits.
        unseen: words for a target that is not seen.
    """
    if target is None or target.time < since:
        return False, unseen
    if target.position_sigma > settings.target_position_sigma:
        return False, f"position uncertain by {target.position_sigma:.3f} m"
    if target.attitude_sigma > math.radians(settings.target_attitude_sigma_deg):
        return False, f"attitude uncertain by {math.degrees(target.attitude_sigma):.1f} deg"
    if goal.inclination_hint is not None:
        inclination = so3.angle_between(so3.quat_rotate(target.q_WS, _UP), _UP)
        if abs(inclination - goal.inclination_hint) > math.radians(settings.inclination_tolerance_deg):
            return False, f"inclination {math.degrees(inclination):.0f} deg, expected {math.degrees(goal.inclination_hint):.0f} deg"
    return True, ""
