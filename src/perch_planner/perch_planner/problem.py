"""Definition of a perching problem: start, surface, waypoints, settings and limits."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property
from math import atan2, hypot
from typing import Any, NamedTuple

import numpy as np

from perch_core.config import choice, quantity
from perch_core.errors import ConfigError
from perch_core.surface import PerchSurface
from perch_core.trajectory import FlatTrajectory
from perch_core.vehicle import GRAVITY, Vehicle

_ZERO: Any = (0.0, 0.0, 0.0)  # made an array, as what is given
_STAMP_ROUNDING = 1e-6         # of the difference of two stamps of today in seconds [s]


def _vector(source: str, key: str, value: Any) -> np.ndarray:
    """Convert a value to a finite vector, shape (3,).

    Raises:
        ConfigError: wrong size, or a value that is not finite.
    """
    try:
        out = np.array(value, float)
    except (TypeError, ValueError):
        raise ConfigError(source, key, f"{value!r} is not three numbers") from None
    if out.shape != (3,) or not np.isfinite(out).all():
        raise ConfigError(source, key, f"{out.tolist()} is not three finite numbers")
    return out


@dataclass(frozen=True)
class StartState:
    """Flat outputs at the start.

    Attributes:
        p: position of the centre of mass in W [m], shape (3,).
        v, a, j: velocity [m/s], acceleration without gravity [m/s^2], jerk [m/s^3], shape (3,).
        yaw, yaw_rate, yaw_acc: heading [rad, rad/s, rad/s^2].
    """

    p: np.ndarray
    v: np.ndarray = _ZERO
    a: np.ndarray = _ZERO
    j: np.ndarray = _ZERO
    yaw: float = 0.0
    yaw_rate: float = 0.0
    yaw_acc: float = 0.0

    def __post_init__(self) -> None:
        for key in ("p", "v", "a", "j"):
            object.__setattr__(self, key, _vector("start", key, getattr(self, key)))
        for key, unit in (("yaw", "rad"), ("yaw_rate", "rad/s"), ("yaw_acc", "rad/s^2")):
            value = float(getattr(self, key))
            if not abs(value) <= 1e3:
                raise ConfigError("start", key, f"{value:g} is outside [-1000, 1000] {unit}")
            object.__setattr__(self, key, value)

    @classmethod
    def on(cls, trajectory: FlatTrajectory, t: float) -> StartState:
        """Return the state of a running trajectory at a time [s since its start], where a new plan replaces the rest.

        Raises:
            ConfigError: the time is outside the trajectory.
        """
        if not -_STAMP_ROUNDING <= t <= trajectory.duration + _STAMP_ROUNDING:
            span = f"[0, {trajectory.duration:g}] s"
            raise ConfigError("start", "time", f"{t:g} s is outside the current trajectory {span}")
        at = trajectory.sample(t)
        return cls(at.p, at.v, at.a, at.j, at.yaw, at.yaw_rate, at.yaw_acc)


@dataclass(frozen=True)
class Waypoint:
    """Position to pass, with optional derivatives. [M:eq6]

    Attributes:
        p: position in W [m], shape (3,).
        v, a, j: velocity, acceleration and jerk in W, shape (3,); None: chosen by the planner.
    """

    p: np.ndarray
    v: np.ndarray | None = None
    a: np.ndarray | None = None
    j: np.ndarray | None = None

    def __post_init__(self) -> None:
        for key in ("p", "v", "a", "j"):
            value = getattr(self, key)
            if value is not None:
                object.__setattr__(self, key, _vector("waypoint", key, value))


@dataclass(frozen=True)
class PerchProblem:
    """One perch to plan.

    Attributes:
        start: flat outputs at time 0.
        surface: the surface at time 0; the vehicle ends at perch_offset in front of its centre, with b3 = s3.
        waypoints: positions to pass, in order; in W, also for a moving target.
        target_velocity: constant velocity of the surface in W [m/s], shape (3,).
        segment_times: first guess of the segment durations [s], one more than waypoints; None: chosen by the planner, which also
            replaces guesses to waypoints that are far too short.
    """

    start: StartState
    surface: PerchSurface
    waypoints: tuple[Waypoint, ...] = ()
    target_velocity: np.ndarray = _ZERO
    segment_times: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "target_velocity", _vector("target", "velocity", self.target_velocity))
        object.__setattr__(self, "waypoints", tuple(self.waypoints))
        if self.segment_times is not None:
            times = tuple(float(t) for t in self.segment_times)
            if len(times) != len(self.waypoints) + 1:
                raise ConfigError("problem", "segment_times", f"has {len(times)} entries, needs {len(self.waypoints) + 1}")
            if not all(1e-3 < t < 1e3 for t in times):
                raise ConfigError("problem", "segment_times", f"{list(times)} are not durations in (0.001, 1000) s")
            object.__setattr__(self, "segment_times", times)

    @cached_property
    def points(self) -> np.ndarray:
        """Start, waypoints and the surface's centre at time 0, in W [m], shape (waypoints + 2, 3)."""
        return np.concatenate([self.start.p, *[w.p for w in self.waypoints], self.surface.p_WS]).reshape(-1, 3)


@dataclass(frozen=True)
class PerchParameters:
    """Parameters of the planner: `config/perching_planner.yaml`."""

    impact_acceleration: float = quantity(3.3, unit="m/s^2", above=0.0, high=100.0, doc="alpha of [M:eq11]")
    impact_speed_min: float = quantity(0.65, unit="m/s", low=0.0, high=20.0, doc="v_min of [M:eq14], along -s3, at the planned contact")
    impact_speed_max: float = quantity(0.8, unit="m/s", low=0.0, high=20.0, doc="v_max of [M:eq14], along -s3")
    contact_delay: float = quantity(0.04, unit="s", low=0.0, high=0.2,
                                    doc="speed and slip are bounded on time and, where both can be, so late: errors and lag delay a contact")
    tangential_speed_max: float = quantity(0.3, unit="m/s", above=0.0, high=20.0, doc="slip over the surface at contact")
    tube_time: float = quantity(0.12, unit="s", low=0.0, high=2.0, doc="t_k of [M:eq15]")
    thrust_reserve: float = quantity(0.9, above=0.0, high=1.0, doc="share of the vehicle's thrust that a plan may use")
    rotor_margin: float = quantity(0.0, low=-1e3, high=0.4, doc="share of a rotor's range kept free at both its ends; negative: of what lies beyond")
    speed_max: float = quantity(12.0, unit="m/s", above=0.0, doc="bound on the speed in W")
    height_min: float = quantity(0.15, unit="m", low=-1e4, high=1e4, doc="floor for the centre of mass")
    height_max: float = quantity(1e3, unit="m", low=-1e4, high=1e4, doc="ceiling for the centre of mass")
    clearance_min: float = quantity(0.0, unit="m", low=-1e3, high=2.0, doc="least distance of the body's rim from the surface; negative: of the plate, too")
    duration_max: float = quantity(20.0, unit="s", above=0.1, high=600.0, doc="longest plan")

    def __post_init__(self) -> None:
        for item in fields(self):
            if item.type == "float":  # compiled kernels take no integers
                object.__setattr__(self, item.name, float(getattr(self, item.name)))
        if self.impact_speed_max < self.impact_speed_min:
            raise ConfigError("", "impact_speed_max",
                              f"{self.impact_speed_max:g} is below impact_speed_min {self.impact_speed_min:g} m/s")
        if self.height_max <= self.height_min:
            raise ConfigError("", "height_max", f"{self.height_max:g} is not above height_min {self.height_min:g} m")


@dataclass(frozen=True)
class PerchSettings(PerchParameters):
    """Parameters of the planner, and the options of a single plan: of a request, a problem file or a trial with relaxed limits.

    Where the description of an option names the vehicle, 0 stands for the limit of the vehicle file.
    """

    impact_acceleration_fixed: bool = quantity(False, doc="impact_acceleration also for surfaces that face up, for which it is raised otherwise")
    thrust_max: float = quantity(0.0, unit="N", low=0.0, high=4e3, doc="tau_max of [M:eq16]; 0: thrust_reserve x the vehicle's")
    thrust_min: float = quantity(0.0, unit="N", low=0.0, doc="tau_min of [M:eq16]; 0: the vehicle's")
    body_rate_max: float = quantity(0.0, unit="rad/s", low=0.0, doc="bound on |omega|; 0: the vehicle's")
    objective: str = choice("snap", options=("snap", "jerk"), doc="cost of [M:eq4]")
    minimum_time: bool = quantity(False, doc="shorten the plan until a bound is active")

    def for_surface(self, surface: PerchSurface) -> PerchSettings:
        """Return the settings of a plan to a surface, with a raised `impact_acceleration` where the surface faces up.

        Onto such a surface, the vehicle falls with g s3_z - alpha through the whole tube. With a small alpha, its normal speed at
        the start of the tube would be reversed: it would rise from below the surface. Half of v_min is therefore kept there:
        alpha >= g s3_z - v_min / (2 (t_k + contact_delay)).
        """
        if self.impact_acceleration_fixed or self.tube_time <= 0.0:
            return self
        shed = 0.5 * self.impact_speed_min / (self.tube_time + self.contact_delay)
        least = GRAVITY * float(surface.normal[2]) - shed
        return self if least <= self.impact_acceleration else replace(self, impact_acceleration=least)


class Limits(NamedTuple):
    """Limits that hold over the whole plan.

    Attributes:
        thrust: collective thrust, least and greatest [N]. [M:eq16]
        body_rate: greatest |omega| [rad/s].
        speed: greatest speed in W [m/s].
        height: least and greatest height of the centre of mass [m].
        extension: radius of the disc around the centre of mass that stays in front of the surface until contact [m].
        clearance: least distance of that disc from the surface [m]; where it is negative, also that of the velcro plate.
        perch_offset: distance of the velcro plate below the centre of mass [m].
        rotor_thrust: thrust of each rotor, least and greatest [N].
    """

    thrust: tuple[float, float]
    body_rate: float
    speed: float
    height: tuple[float, float]
    extension: float
    clearance: float
    perch_offset: float
    rotor_thrust: tuple[float, float]

    @classmethod
    def of(cls, settings: PerchSettings, vehicle: Vehicle) -> Limits:
        """Return the limits of the settings, with those of the vehicle where the settings leave them open."""
        least, most = vehicle.thrust_min, vehicle.thrust_max
        free = settings.rotor_margin * (most - least)
        return cls(
            thrust=(settings.thrust_min or 4.0 * least, settings.thrust_max or settings.thrust_reserve * 4.0 * most),
            body_rate=settings.body_rate_max or vehicle.body_rate_max,
            speed=settings.speed_max,
            height=(settings.height_min, settings.height_max),
            extension=max(vehicle.body_radii[:2]),
            clearance=settings.clearance_min,
            perch_offset=vehicle.perch_offset,
            rotor_thrust=(least + free, most - free),
        )


def contact_heading(surface: PerchSurface) -> float:
    """Yaw at contact with b2_des parallel to s2 [rad]. [M:eq12]

    Where s2 lies within 30 degrees of the vertical, the heading of the approach, -s3, is used instead.
    """
    s2, s3 = surface.R_WS[:, 1], surface.normal
    if hypot(s2[0], s2[1]) > 0.5:
        return atan2(-s2[0], s2[1])
    return atan2(-s3[1], -s3[0])
