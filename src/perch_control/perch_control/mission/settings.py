"""Parameters of the mission."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from perch_core.config import quantity
from perch_core.errors import ConfigError
from perch_control.admission import CONTACT_EARLY


@dataclass(frozen=True, kw_only=True)
class MissionSettings:
    """Times, speeds and limits of the mission."""

    takeoff_height: float = quantity(1.2, unit="m", above=0.0, high=10.0, doc="default height of the search hover")
    transit_speed: float = quantity(0.8, unit="m/s", above=0.0, high=5.0, doc="mean speed of take-off and search moves")
    settle_time: ClassVar[float] = 0.6  # rest after a move before it counts as reached [s]
    settle_speed: ClassVar[float] = 0.15  # speed below which the vehicle rests [m/s]
    search_timeout: float = quantity(10.0, unit="s", above=0.0, high=300.0, doc="longest search; the goal then ends with NOT_FOUND")
    search_dwell: ClassVar[float] = 2.0  # time of observation at each place of the pattern [s]
    target_settle: ClassVar[float] = 0.5  # observe the target this long before planning [s]
    target_position_sigma: float = quantity(0.06, unit="m", above=0.0, high=1.0,
                                          doc="largest 1-sigma of the target's position relative to the vehicle, to plan on it")
    planner_latency: float = quantity(0.04, unit="s", low=0.0, high=5.0, doc="a plan is used this long after its request")
    powerline_latency: float = quantity(1.0, unit="s", low=0.0, high=10.0, doc="the same for a powerline plan")
    way_out_spacing: ClassVar[float] = 0.3  # between the starts of recoveries that are kept ready [s]
    way_out_until: ClassVar[float] = 0.3  # from the last of them to the contact: the wire is still beyond the gripper's reach [s]
    powerline_replan_period: ClassVar[float] = 0.35  # [s]
    powerline_replan_until: ClassVar[float] = 0.5  # no new plan starts closer than this to the contact [s]
    shift_distance: ClassVar[float] = 0.004  # ... where the wire has moved by more than this ... [m]
    shift_max: ClassVar[float] = 0.15  # ... and less than this; beyond it the rest is planned again [m]
    replan_shift: ClassVar[float] = 0.3  # a new plan whose contact is earlier or later by more is not flown [s]
    mapping_approach: float = quantity(2.8, unit="m", low=0.0, high=10.0, doc="approach towards the lines, to map them better")
    mapping_standoff: float = quantity(2.2, unit="m", above=0.0, high=50.0, doc="least distance to the target in that approach")
    plan_lead: float = quantity(0.1, unit="s", low=0.01, high=5.0, doc="a plan starts this long after its request, or 0.04 s after its use where that is later")
    replan_period: ClassVar[float] = 0.1  # [s]
    replan_until: ClassVar[float] = 0.4  # no new plan closer than this to the contact [s]
    contact_time: float = quantity(0.25, unit="s", low=0.0, high=2.0, doc="how long adhesion is awaited after the planned contact")
    contact_early: ClassVar[float] = CONTACT_EARLY  # how long before the planned contact adhesion is monitored [s]
    waypoints: tuple[float, ...] = quantity((), unit="m, deg", doc="of an inspection, in map: x, y, z, yaw of each, one after the other")
    inspection_speed: float = quantity(0.5, unit="m/s", above=0.0, high=5.0, doc="mean speed between waypoints")
    rest_time: ClassVar[float] = 0.6  # rest with motors off that confirms the perch [s]
    arming_timeout: ClassVar[float] = 10.0  # [s]
    arm_retry_period: ClassVar[float] = 1.0  # between two requests to arm [s]
    phase_timeout: ClassVar[float] = 20.0  # longest recovery, and longest wait for a planner or for rest after a move [s]

    def __post_init__(self) -> None:
        if len(self.waypoints) % 4:
            raise ConfigError("", "waypoints", f"has {len(self.waypoints)} entries, not 4 (x, y, z, yaw) for each waypoint")

    @property
    def places(self) -> list[tuple[np.ndarray, float]]:
        """The waypoints: positions in W [m], shape (3,), and yaws [rad]."""
        return [(np.array(self.waypoints[k:k + 3]), math.radians(self.waypoints[k + 3])) for k in range(0, len(self.waypoints), 4)]

    def lead(self, latency: float) -> float:
        """Time from the request of a plan to its start, where the plan is used `latency` after the request [s]."""
        return max(self.plan_lead, latency + 0.04)
