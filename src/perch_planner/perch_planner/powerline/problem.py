"""Powerline problems as YAML files of `kind: powerline`: read and planned without ROS."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from perch_core import config
from perch_core.arrays import Quaternion, Vector3
from perch_core.config import choice, label, part, quantity, text
from perch_core.errors import ConfigError
from perch_core.lines import Segment
from perch_core.rotor_model import RotorModel, V, W, hover_state
from perch_core.vehicle import GRAVITY, Vehicle, load_vehicle
from perch_planner.powerline.formulation import DEFAULT, PUBLISHED
from perch_planner.powerline.plan import PowerlinePlan
from perch_planner.powerline.planner import PowerlinePlanner
from perch_planner.powerline.request import PerchPose, PowerlineRequest
from perch_planner.powerline.settings import PowerlineSettings

ZERO = (0.0, 0.0, 0.0)


def _check_direction(key: str, value: tuple[float, ...]) -> None:
    if not np.linalg.norm(value) > 1e-6:
        raise ConfigError("", key, f"{list(value)} has no direction")


@dataclass(frozen=True, kw_only=True)
class LineConfig:
    """A segment; its id is its index in the list."""

    centre: Vector3 = quantity(unit="m")
    direction: Vector3 = quantity(doc="need not be normalised")
    half_length: float = quantity(unit="m", above=0.0)
    radius: float = quantity(0.03, unit="m", above=0.0)

    def __post_init__(self) -> None:
        _check_direction("direction", self.direction)


@dataclass(frozen=True, kw_only=True)
class StartConfig:
    """Start of the manoeuvre, with the rotor thrusts of a hover."""

    position: Vector3 = quantity(unit="m")
    orientation: Quaternion = quantity((0.0, 0.0, 0.0, 1.0), doc="xyzw; normalised")
    velocity: Vector3 = quantity(ZERO, unit="m/s")
    body_rate: Vector3 = quantity(ZERO, unit="rad/s")

    def __post_init__(self) -> None:
        _check_direction("orientation", self.orientation)


@dataclass(frozen=True, kw_only=True)
class PerchConfig:
    """The perch: either `position` and `orientation`, or `point` of the target line and `pitch_deg` with free yaw."""

    position: Vector3 | None = quantity(None, unit="m", doc="of the centre of mass")
    orientation: Quaternion | None = quantity(None, doc="xyzw; only b3 counts")
    point: Vector3 | None = quantity(None, unit="m", doc="near the target line")
    pitch_deg: float | None = quantity(None, unit="deg", low=0.0, high=180.0, doc="about the line, from the vertical")
    velocity: Vector3 = quantity(ZERO, unit="m/s")

    def __post_init__(self) -> None:
        pose = (self.position is not None, self.orientation is not None)
        pitch = (self.point is not None, self.pitch_deg is not None)
        if pose + pitch not in ((True, True, False, False), (False, False, True, True)):
            raise ConfigError("", "position", "give position and orientation, or point and pitch_deg")
        if self.orientation is not None:
            _check_direction("orientation", self.orientation)


@dataclass(frozen=True, kw_only=True)
class PowerlineProblem:
    """A problem file."""

    kind: str = choice(options=("powerline",))
    name: str = label()
    description: str = text("")
    vehicle: str = text("rpg")
    gravity: float = quantity(GRAVITY, unit="m/s^2", above=0.0, high=30.0)
    lines: tuple[LineConfig, ...] = quantity(())
    target: int = quantity(0, low=0, doc="place of the target line in the list")
    start: StartConfig = text()
    perch: PerchConfig = text()
    perception: bool = quantity(False, doc="keep the target line in view [P:eq8-13]")
    recovery: bool = quantity(True, doc="append the recovery [P:V-B]")
    published: bool = quantity(False, doc="the program as the authors published it")
    settings: PowerlineSettings = part(PowerlineSettings)

    def segments(self) -> tuple[Segment, ...]:
        """Return the line segments, with their indices as ids."""
        return tuple(Segment(np.array(c.centre), np.array(c.direction), c.half_length, c.radius, i)
                     for i, c in enumerate(self.lines))

    def request(self, vehicle: Vehicle) -> PowerlineRequest:
        """Convert the problem into a request of the planner.

        Raises:
            PlanningRefusal: the target is not among the lines, or the perch is not usable.
        """
        start = hover_state(RotorModel.of(vehicle, self.gravity), np.array(self.start.position), np.array(self.start.orientation))
        start[V], start[W] = self.start.velocity, self.start.body_rate
        request = PowerlineRequest(start, self.segments(), self.target, None, self.perception, self.recovery)
        target = request.target()
        velocity = np.array(self.perch.velocity)
        if self.perch.position is not None:
            q_WB = np.array(self.perch.orientation)
            perch = PerchPose.at(np.array(self.perch.position), q_WB / np.linalg.norm(q_WB), velocity)
        else:
            assert self.perch.pitch_deg is not None  # it comes with the point
            perch = PerchPose.on_line(target, np.array(self.perch.point), np.radians(self.perch.pitch_deg),
                                      vehicle.wire_offset, start[:3], velocity)
        return PowerlineRequest(start, request.lines, self.target, perch, self.perception, self.recovery)


@dataclass(frozen=True)
class PlannedProblem:
    """A problem with its plan, and the vehicle, request and planner of the plan."""

    problem: PowerlineProblem
    vehicle: Vehicle
    request: PowerlineRequest
    planner: PowerlinePlanner
    plan: PowerlinePlan


def load(name_or_path: str | Path) -> PowerlineProblem:
    """Read `config/problems/<name>.yaml` or a file.

    Raises:
        ConfigError: no such file, or an invalid value.
    """
    return config.load(PowerlineProblem, config.find("problems", name_or_path))


def plan(problem: PowerlineProblem, **changes: Any) -> PlannedProblem:
    """Plan a problem in this process.

    Args:
        problem: what to plan.
        changes: fields of the request to replace (`perception=True`, `with_recovery=False`).

    Raises:
        ConfigError: unknown vehicle.
        PlanningRefusal: bad request, or no trajectory within the limits.
    """
    vehicle = load_vehicle(problem.vehicle)
    planner = PowerlinePlanner(vehicle, problem.settings, problem.gravity, PUBLISHED if problem.published else DEFAULT)
    request = problem.request(vehicle)
    for name, value in changes.items():
        request = config.replace(request, **{name: value})
    return PlannedProblem(problem, vehicle, request, planner, planner.plan(request))
