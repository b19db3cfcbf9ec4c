"""Parameters of the node `mission`."""

from __future__ import annotations

from dataclasses import dataclass

from perch_core.config import part, text
from perch_core.imu_axes import IMU_AXES
from perch_control.mission.settings import MissionSettings


@dataclass(frozen=True, kw_only=True)
class MissionParameters:
    """Parameters of the node `mission`."""

    sensors: str = text("", doc=IMU_AXES)
    mission: MissionSettings = part(MissionSettings)
