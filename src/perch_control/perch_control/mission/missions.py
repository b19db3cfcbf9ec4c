"""Registry of the missions: name -> class. Another mission takes one more line; see docs/howto/own_mission.md."""

from __future__ import annotations

from typing import TYPE_CHECKING

from perch_core.errors import ConfigError
from perch_core.registry import resolved

if TYPE_CHECKING:
    from perch_control.mission.machine import MissionMachine

MISSIONS: dict[str, str] = {
    "surface": "perch_control.mission.surface:SurfaceMission",
    "powerline": "perch_control.mission.wire:PowerlineMission",
    "inspection": "perch_control.mission.inspection:InspectionMission",
}
"""The `mode` of a goal of the Perch action is the mission's place in this list, from 0: others are added at the end."""


def mode_of(name: str) -> int:
    """Return the mode of a goal for a mission.

    Raises:
        ConfigError: there is no mission with this name.
    """
    if name not in MISSIONS:
        raise ConfigError("", "mission.type", f"{name!r} is not one of {', '.join(MISSIONS)}")
    return list(MISSIONS).index(name)


def mission_class(mode: int) -> type[MissionMachine]:
    """Return the class of a mission.

    Raises:
        ConfigError: there is no mission with this mode.
    """
    if not 0 <= mode < len(MISSIONS):
        raise ConfigError("", "mode", f"{mode} is not one of {', '.join(f'{k} ({name})' for k, name in enumerate(MISSIONS))}")
    return resolved(list(MISSIONS.values())[mode])
