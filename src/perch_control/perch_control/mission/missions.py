"""The missions that a goal can ask for: its mode -> class. A mission of your own is one more line."""

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
    """The class of a mission.

    Raises:
        KeyError: there is none for this mode.
    """
    return resolved(MISSIONS[mode])


def known_modes() -> str:
    """The modes in words."""
    return ", ".join(f"{Mode(mode).name} ({mode})" if mode in tuple(Mode) else str(int(mode)) for mode in MISSIONS)
