"""Limits of the supervisor and of the references that the controller makes itself."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from perch_control.odometry_gate import OdometryLimits
from perch_control.recovery import RecoverySettings
from perch_control.rotor_health import RotorHealthSettings
from perch_core.config import part, quantity

Vector3 = tuple[float, float, float]


@dataclass(frozen=True)
class FlightSettings:
    """When the supervisor steps in, and how hover, landing and descent are flown."""

    brake_deceleration: float = quantity(4.0, unit="m/s^2", above=0.0, high=20.0)
    brake_hard: ClassVar[float] = 8.0  # at most, where the trajectory leads to a surface [m/s^2]
    leave_time: ClassVar[float] = 0.6  # an abort flies on for at most so long, to where a planned recovery begins [s]
    land_speed: float = quantity(0.35, unit="m/s", above=0.0, high=2.0)
    ground_time: ClassVar[float] = 0.25  # descent has stopped for so long: on the ground [s]
    ground_gap: ClassVar[float] = 0.12  # the descending reference is so far below the vehicle [m]
    descent_share: float = quantity(0.93, unit="-", above=0.5, high=1.0, doc="thrust / weight of a descent without position")
    descent_speed: float = quantity(0.6, unit="m/s", above=0.0, doc="the same: a faster fall is braked, as far as the velocity is known")
    descent_gain: ClassVar[float] = 4.0  # the same: braking per speed ... [1/s]
    descent_braking: ClassVar[float] = 5.0  # ... and at most so much [m/s^2]
    # specific force that counts as hitting the ground in a descent without position [m/s^2]
    impact_acceleration: ClassVar[float] = 25.0
    start_gap: ClassVar[float] = 0.35  # largest distance between a trajectory's start and the vehicle [m]
    start_speed_gap: ClassVar[float] = 1.0  # the same for the velocity [m/s]
    start_late: ClassVar[float] = 0.5  # oldest start stamp that is accepted [s]
    joint_gap: ClassVar[float] = 0.02  # largest step inside a trajectory; ten times this for the velocity [m/s] [m]
    tilt_margin_deg: ClassVar[float] = 45.0  # tilt away from the reference's thrust direction [deg]
    rate_factor: ClassVar[float] = 1.6  # body rate over the vehicle's body_rate_max
    position_error_max: float = quantity(1.0, unit="m", above=0.0)
    fault_time: ClassVar[float] = 0.12  # tilt, rate or position are out for so long before the supervisor acts [s]
    missed_speed: float = quantity(1.0, unit="m/s", above=0.0, doc="faster than this after the planned contact: it was missed")
    down_time: ClassVar[float] = 1.2  # at rest and tilted for so long, or without any sensor: motors off [s]
    margin_time: float = quantity(1.0, unit="s", above=0.0, doc="rotors at their limit for so long: land")
    margin_min: float = quantity(0.02, unit="-", low=0.0, high=0.5, doc="thrust margin that counts as none")
    margin_perch: float = quantity(0.15, unit="-", low=0.0, high=0.5, doc="a perch is refused where the mean margin in hover is less")
    fence_low: Vector3 = quantity((-20.0, -20.0, -5.0), unit="m", doc="geofence in map")
    fence_high: Vector3 = quantity((20.0, 20.0, 20.0), unit="m", doc="geofence in map")
    fence_slack: float = quantity(1.0, unit="m", low=0.0, doc="so far outside the fence: land")
    coasting_time: float = quantity(1.0, unit="s", above=0.0, doc="estimator without VIO for so long: hover")
    coasting_land_time: float = quantity(3.0, unit="s", above=0.0, doc="estimator without VIO for so long: descend")
    silence_time: float = quantity(60.0, unit="s", above=0.0, doc="hovering without a new order for so long: land")
    idle_time: float = quantity(10.0, unit="s", above=0.0, doc="armed on the ground without a trajectory for so long: motors off")
    odometry: OdometryLimits = part(OdometryLimits)
    recovery: RecoverySettings = part(RecoverySettings)
    rotors: RotorHealthSettings = part(RotorHealthSettings)
