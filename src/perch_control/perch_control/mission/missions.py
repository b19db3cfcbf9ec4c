"""Registry of the missions: mode of the goal -> class. Another mission takes one more line."""

from __future__ import annotations

from typing import TYPE_CHECKING

from perch_control.mission.values import Mode
from perch_core.registry import resolved

if TYPE_CHECKING:
    from perch_control.mission.machine import MissionMachine

MISSIONS: dict[int, str] = {
    Mode.SURFACE: "perch_control.mission.surface:SurfaceMission",
    Mode.POWERLINE: "perch_control.mission.wire:PowerlineMission",
    Mode.INSPECTION: "perch_control.mission.inspection:InspectionMission",
}


def mission_class(mode: int) -> type[MissionMachine]:
    """Return the class of a mission.

    Raises:
        KeyError: there is no mission for this mode.
    """
    return resolved(MISSIONS[mode])


def known_modes() -> str:
    """Return the registered modes as text."""
    return ", ".join(f"{Mode(mode).name} ({mode})" if mode in tuple(Mode) else str(int(mode)) for mode in MISSIONS)
