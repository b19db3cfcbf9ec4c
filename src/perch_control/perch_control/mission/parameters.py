"""Parameters of the node `mission`."""

from __future__ import annotations

from dataclasses import dataclass

from perch_core.config import part, quantity
from perch_control.mission.settings import MissionSettings


@dataclass(frozen=True, kw_only=True)
class MissionParameters:
    """Parameters of the node `mission`."""

    hold_for_goal: bool = quantity(False, doc="in lockstep, hold simulation time at zero until a goal comes")
    mission: MissionSettings = part(MissionSettings)
