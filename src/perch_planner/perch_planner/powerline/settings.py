"""Settings of powerline planning: margins, durations, perception weights, deadline."""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite

from perch_core.config import part, quantity, text
from perch_core.errors import ConfigError
from perch_core.vehicle import Vehicle

DEADLINE_MAX = 10.0
"""Greatest deadline of a plan, which also limits the deadlines of requests [s]."""


@dataclass(frozen=True, kw_only=True)
class PerceptionWeights:
    """Weights of [P:eq9, P:eq14h, P:eq14i] at the start of the horizon."""

    reprojection: float = quantity(50.0, low=0.0, doc="line from the image centre, in focal lengths")
    cheirality: float = quantity(100.0, low=0.0, doc="soft constraint: the line is in front")
    visibility: float = quantity(100.0, low=0.0, doc="soft constraint: the segment is at the centre")


@dataclass(frozen=True, kw_only=True)
class Margins:
    """Distances of the nodes from the limits, so that the limits also hold between the nodes.

    A plan whose 1 ms trajectory violates a limit is solved again with a larger N. [P:V-B]
    """

    height: float = quantity(0.05, unit="m", low=0.0, high=1.0, doc="above height_min")
    clearance: float = quantity(0.2, low=0.0, high=0.5, doc="(d^2 - 1) / (d^2 + 1) of the scaled distance d")
    leaving: float = quantity(0.45, low=0.0, high=0.6, doc="the same for a recovery, from a quarter of its time on")
    approaching: float = quantity(0.4, low=0.0, high=0.6, doc="the same for a perch, until a tenth of its time before the end; less than clearance: none")
    thrust: float = quantity(0.01, unit="N", low=0.0, high=5.0, doc="of each rotor, from both ends of its range")
    body_rate: float = quantity(0.2, unit="rad/s", low=0.0, high=5.0, doc="below the largest body rate")


@dataclass(frozen=True, kw_only=True)
class PowerlineSettings:
    """Settings of powerline plans that are common to all requests."""

    intervals: int = quantity(30, low=10, high=120, doc="N of [P:eq14]")
    height_min: float = quantity(0.8, unit="m", low=-1000.0, high=1000.0, doc="z_min of [P:eq14e]")
    duration: tuple[float, float] = quantity((0.05, 5.0), unit="s", above=0.0, high=30.0, doc="bounds of T, perch")
    recovery_duration: tuple[float, float] = quantity((0.5, 2.0), unit="s", above=0.0, high=30.0, doc="bounds of T, recovery")
    thrust_share: float = quantity(0.95, above=0.0, high=1.0, doc="share of a rotor's greatest thrust that a plan may use")
    perception: PerceptionWeights = part(PerceptionWeights)
    margins: Margins = part(Margins)
    deadline: float = quantity(2.0, unit="s", above=0.0, high=DEADLINE_MAX, doc="wall-clock limit of a plan")
    camera: str = text("front", doc="camera that keeps the line in view")

    def __post_init__(self) -> None:
        for key in ("duration", "recovery_duration"):
            low, high = getattr(self, key)
            if not low < high:
                raise ConfigError("", key, f"[{low:g}, {high:g}] s is not an interval")

    def check(self, vehicle: Vehicle) -> None:
        """Refuse a vehicle for which these settings cannot be used.

        Raises:
            ConfigError: the vehicle lacks the camera or `thrust_rate_max`, or the margins leave nothing of its thrust or body rate.
        """
        if self.camera not in vehicle.mounts:
            raise ConfigError("powerline_planner", "camera", f"vehicle {vehicle.name} has no camera {self.camera!r}")
        if not isfinite(vehicle.thrust_rate_max):
            raise ConfigError("powerline_planner", "vehicle", f"{vehicle.name} has no thrust_rate_max, which [P:eq14g] needs")
        low, high = vehicle.thrust_min + self.margins.thrust, self.thrust_share * vehicle.thrust_max - self.margins.thrust
        if not low < high:
            raise ConfigError("powerline_planner", "margins.thrust", f"of a rotor of {vehicle.name} nothing is left: [{low:g}, {high:g}] N")
        if not self.margins.body_rate < vehicle.body_rate_max:
            raise ConfigError("powerline_planner", "margins.body_rate", f"{self.margins.body_rate:g} rad/s is not below the largest body rate "
                                                                        f"of {vehicle.name}, {vehicle.body_rate_max:g} rad/s")
