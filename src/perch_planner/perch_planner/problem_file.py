"""Planning problems of kind `perch` as YAML: `config/problems/*.yaml`."""

from __future__ import annotations

from dataclasses import dataclass
from math import radians
from typing import Any

import numpy as np

from perch_core import config
from perch_core.arrays import Vector3
from perch_core.config import part, quantity, text
from perch_core.errors import ConfigError
from perch_core.surface import PerchSurface
from perch_core.vehicle import Vehicle, load_vehicle
from perch_planner.problem import PerchProblem, PerchSettings, StartState, Waypoint

_ZERO = (0.0, 0.0, 0.0)


@dataclass(frozen=True, kw_only=True)
class StartSection:
    """State at the start of the plan."""

    position: Vector3 = quantity(unit="m")
    velocity: Vector3 = quantity(_ZERO, unit="m/s")
    acceleration: Vector3 = quantity(_ZERO, unit="m/s^2")
    jerk: Vector3 = quantity(_ZERO, unit="m/s^3")
    yaw_deg: float = quantity(0.0, unit="deg", low=-360.0, high=360.0)
    yaw_rate: float = quantity(0.0, unit="rad/s")


@dataclass(frozen=True, kw_only=True)
class TargetSection:
    """Pose and velocity of the surface."""

    position: Vector3 = quantity(unit="m", doc="centre of the pad")
    inclination_deg: float = quantity(unit="deg", low=0.0, high=180.0, doc="0 a table, 90 a wall, 180 a ceiling")
    heading_deg: float = quantity(0.0, unit="deg", low=-360.0, high=360.0, doc="heading of the approach")
    velocity: Vector3 = quantity(_ZERO, unit="m/s")


@dataclass(frozen=True, kw_only=True)
class WaypointSection:
    """Position to pass, with optional derivatives."""

    position: Vector3 = quantity(unit="m")
    velocity: Vector3 | None = quantity(None, unit="m/s")
    acceleration: Vector3 | None = quantity(None, unit="m/s^2")
    jerk: Vector3 | None = quantity(None, unit="m/s^3")


@dataclass(frozen=True, kw_only=True)
class PerchFile:
    """A problem file of kind `perch`."""

    kind: str = text()
    vehicle: str = text("snapdragon", doc="config/vehicles/<name>.yaml, or a file")
    start: StartSection = text()
    target: TargetSection = text()
    waypoints: tuple[WaypointSection, ...] = text(())
    segment_times: tuple[float, ...] | None = text(None)
    settings: PerchSettings = part(PerchSettings)


def read_problem(mapping: Any, source: str) -> tuple[PerchProblem, PerchSettings, Vehicle]:
    """Return problem, settings and vehicle of a parsed file.

    Args:
        mapping: content of the YAML file.
        source: file name, for messages.

    Raises:
        ConfigError: unknown or missing keys, wrong types, values out of range.
    """
    content = config.from_mapping(PerchFile, mapping, source)
    start, target = content.start, content.target
    try:
        surface = PerchSurface.from_inclination(np.array(target.position), radians(target.inclination_deg),
                                                radians(target.heading_deg))
        problem = PerchProblem(
            StartState(np.array(start.position), np.array(start.velocity), np.array(start.acceleration), np.array(start.jerk),
                       radians(start.yaw_deg), start.yaw_rate),
            surface, tuple(Waypoint(np.array(w.position), *(None if v is None else np.array(v) for v in (w.velocity, w.acceleration, w.jerk)))
                           for w in content.waypoints),
            np.array(target.velocity), content.segment_times)
    except ConfigError as error:
        raise ConfigError(source, error.key, error.problem) from None
    return problem, content.settings, load_vehicle(content.vehicle)
