"""Limits of the supervisor and of the references that the controller makes itself."""

from __future__ import annotations

from dataclasses import dataclass

from perch_control.odometry_gate import OdometryLimits
from perch_control.recovery import RecoverySettings
from perch_control.rotor_health import RotorHealthSettings
from perch_core.config import part, quantity

Vector3 = tuple[float, float, float]


@dataclass(frozen=True)
class FlightSettings:
    """When the supervisor steps in, and how hover, landing and descent are flown."""

    brake_deceleration: float = quantity(4.0, unit="m/s^2", above=0.0, high=20.0)
    brake_hard: float = quantity(8.0, unit="m/s^2", above=0.0, high=20.0, doc="at most, where the trajectory leads to a surface")
    leave_time: float = quantity(0.6, unit="s", low=0.0, high=5.0,
                                 doc="an abort flies on for at most so long, to where a planned recovery begins")
    land_speed: float = quantity(0.35, unit="m/s", above=0.0, high=2.0)
    ground_time: float = quantity(0.25, unit="s", above=0.0, doc="descent has stopped for so long: on the ground")
    ground_gap: float = quantity(0.12, unit="m", above=0.0, doc="the descending reference is so far below the vehicle")
    descent_share: float = quantity(0.93, unit="-", above=0.5, high=1.0, doc="thrust / weight of a descent without position")
    descent_speed: float = quantity(0.6, unit="m/s", above=0.0, doc="the same: a faster fall is braked, as far as the velocity is known")
    descent_gain: float = quantity(4.0, unit="1/s", low=0.0, high=20.0, doc="the same: braking per speed ...")
    descent_braking: float = quantity(5.0, unit="m/s^2", low=0.0, high=9.0, doc="... and at most so much")
    impact_acceleration: float = quantity(25.0, unit="m/s^2", above=0.0, doc="specific force that counts as hitting the ground in a descent without position")
    start_gap: float = quantity(0.35, unit="m", above=0.0, doc="largest distance between a trajectory's start and the vehicle")
    start_speed_gap: float = quantity(1.0, unit="m/s", above=0.0, doc="the same for the velocity")
    start_late: float = quantity(0.5, unit="s", low=0.0, doc="oldest start stamp that is accepted")
    joint_gap: float = quantity(0.02, unit="m", above=0.0, doc="largest step inside a trajectory; ten times this for the velocity [m/s]")
    tilt_margin_deg: float = quantity(45.0, unit="deg", above=0.0, high=180.0, doc="tilt away from the reference's thrust direction")
    rate_factor: float = quantity(1.6, unit="-", above=1.0, doc="body rate over the vehicle's body_rate_max")
    position_error_max: float = quantity(1.0, unit="m", above=0.0)
    fault_time: float = quantity(0.12, unit="s", low=0.0, doc="tilt, rate or position are out for so long before the supervisor acts")
    missed_speed: float = quantity(1.0, unit="m/s", above=0.0, doc="faster than this after the planned contact: it was missed")
    down_time: float = quantity(1.2, unit="s", above=0.0, doc="at rest and tilted for so long, or without any sensor: motors off")
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
