"""Parameters of the node `mission`."""

from __future__ import annotations

from dataclasses import dataclass

from perch_core.config import part
from perch_control.mission.settings import MissionSettings


@dataclass(frozen=True, kw_only=True)
class MissionParameters:
    """Parameters of the node `mission`."""

    mission: MissionSettings = part(MissionSettings)
