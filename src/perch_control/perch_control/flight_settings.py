"""Limits of a flight that depend on the place and on the odometry, not on the method."""

from __future__ import annotations

from dataclasses import dataclass

from perch_core.arrays import Vector3
from perch_core.config import quantity
from perch_core.errors import ConfigError


@dataclass(frozen=True)
class FlightSettings:
    """Thresholds of the supervisor, and the landing speed."""

    fence_low: Vector3 = quantity((-20.0, -20.0, -5.0), unit="m", doc="lower corner of the geofence in map")
    fence_high: Vector3 = quantity((20.0, 20.0, 20.0), unit="m", doc="its upper corner")
    position_error_max: float = quantity(1.0, unit="m", above=0.0, doc="farther from the reference: recovery")
    silence_time: float = quantity(60.0, unit="s", above=0.0, doc="hovering without a new order for so long: land")
    odometry_timeout: float = quantity(0.05, unit="s", above=0.0, high=0.25, doc="without usable odometry for longer: descent without position")
    land_speed: float = quantity(0.35, unit="m/s", low=0.1, high=2.0, doc="downwards, while it lands")

    def __post_init__(self) -> None:
        if not all(low < high for low, high in zip(self.fence_low, self.fence_high)):
            raise ConfigError("", "fence_low", f"{tuple(self.fence_low)} is not below fence_high {tuple(self.fence_high)}")
