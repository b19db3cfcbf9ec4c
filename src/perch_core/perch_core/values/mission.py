"""The Perch action: goal, feedback, result. Stamps are whole nanoseconds, quaternions xyzw."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import nan
from typing import NamedTuple

Floats = tuple[float, ...]


@dataclass(frozen=True, kw_only=True)
class PerchGoal:
    """Goal of the action `perch`; fields as in perch_msgs/action/Perch, NaN: the mission's parameters apply.

    Attributes:
        mode: mission; 0 surface, 1 powerline, 2 inspection, others as in `perch_control.mission.missions`.
        search_frame: frame of `search_position` [m] and `search_attitude`; empty: above the start.
    """

    mode: int = 0
    takeoff_height: float = nan
    search_frame: str = ""
    search_position: Floats = (0.0, 0.0, 0.0)
    search_attitude: Floats = (0.0, 0.0, 0.0, 1.0)
    search_timeout: float = nan
    inclination_hint: float = nan
    perch_point: Floats = field(default=(0.0, 0.0, 0.0))
    perch_pitch: float = 0.0
    perception_aware: bool = False
    replan: bool = False
    attempts: int = 0


class PerchFeedback(NamedTuple):
    """Progress of a goal: phase, share of the mission that is done, predicted time to contact [s] (NaN: not on the way), message."""

    phase: str
    progress: float
    time_to_contact: float
    message: str


class PerchResult(NamedTuple):
    """Result of a goal; `error_code` as in perch_msgs/action/Perch, times [s] (`contact_time` NaN: not perched), final pose estimated in W."""

    success: bool
    error_code: int
    message: str
    contact_time: float = nan
    end_time: float = 0.0
    final_position: Floats = (0.0, 0.0, 0.0)
    final_attitude: Floats = (0.0, 0.0, 0.0, 1.0)
