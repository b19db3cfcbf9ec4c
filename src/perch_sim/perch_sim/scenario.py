"""Scenario of a flight: vehicle, world, target, disturbances, mission. Each is one YAML file in `config/scenarios/`."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from perch_core.arrays import Vector3, Vector4
from perch_core.catenary import Catenary
from perch_core.config import choice, label, part, quantity, text
from perch_core.errors import ConfigError, PerchError
from perch_core.extends import load_extended
from perch_core.surface import PerchSurface

NODES = {
    "vehicle": "perch_sim",
    "vio_model": "perch_sim",
    "vio": "perch_perception",
    "estimator": "perch_perception",
    "target_localizer": "perch_perception",
    "powerline_mapper": "perch_perception",
    "perching_planner": "perch_planner",
    "powerline_planner": "perch_planner",
    "controller": "perch_control",
    "mission": "perch_control",
    "description": "perch_core",
    "recorder": "perch_eval",
    "viewer": "perch_eval",
}
"""Node, also the name of its executable -> package."""
OF_THE_FLIGHT = ("scenario", "vehicle", "seed", "participants")
"""Parameters of the node `vehicle` that follow from the scenario as a whole, the flight's seed and its nodes."""
MAX_CABLES = 100


@dataclass(frozen=True, kw_only=True)
class Start:
    """Pose of the vehicle on the ground before the flight."""

    position: Vector3 = quantity((0.0, 0.0, 0.0), unit="m", doc="ground point under the vehicle in map")
    yaw_deg: float = quantity(0.0, unit="deg", low=-180.0, high=180.0)


@dataclass(frozen=True, kw_only=True)
class Target:
    """The pad on an inclined surface."""

    inclination_deg: float = quantity(90.0, unit="deg", low=0.0, high=180.0, doc="0 floor, 90 wall, 180 ceiling")
    distance: float = quantity(1.7, unit="m", low=0.8, high=3.5, doc="horizontal, from the start; tags are read to 3.5 m")
    height: float = quantity(1.2, unit="m", low=0.0, high=10.0, doc="of the pad's centre above the ground")
    bearing_deg: float = quantity(0.0, unit="deg", low=-60.0, high=60.0, doc="of the pad from the start, from the start's yaw")
    turn_deg: float = quantity(0.0, unit="deg", low=-60.0, high=60.0, doc="turn of the surface about the vertical")
    board: str = text("pad_four_tags", doc="tag board, config/boards/<name>.yaml")
    panel_size: tuple[float, float] = quantity((1.2, 1.2), unit="m", above=0.0, high=100.0, doc="the surface around the pad, at least as large")
    velocity: Vector3 = quantity((0.0, 0.0, 0.0), unit="m/s", low=-20.0, high=20.0, doc="of the moving pad in map")


@dataclass(frozen=True, kw_only=True)
class Cable:
    """One cable between two suspension points."""

    start: Vector3 = quantity(unit="m")
    end: Vector3 = quantity(unit="m")
    sag: float = quantity(0.0, unit="m", low=0.0, doc="drop below the chord at mid-span")
    radius: float = quantity(0.03, unit="m", low=1e-4, high=1.0)
    colour: str = choice("red", options=("red", "grey"))

    def catenary(self) -> Catenary:
        """Return the true catenary of the cable; raises PerchError if it has none."""
        return Catenary.from_sag(np.array(self.start), np.array(self.end), self.sag)


@dataclass(frozen=True, kw_only=True)
class World:
    """The room, its light and its cables."""

    room: Vector3 = quantity((10.0, 5.0, 4.0), unit="m", low=0.5, high=1000.0, doc="length, width, height")
    room_centre: tuple[float, float] = quantity((1.0, 0.0), unit="m", doc="x, y of the room's centre in map")
    contrast: float = quantity(0.25, unit="-", low=0.02, high=1.0, doc="texture contrast")
    light: float = quantity(1.0, unit="-", low=0.05, high=3.0)
    cables: tuple[Cable, ...] = quantity(())


@dataclass(frozen=True, kw_only=True)
class Wind:
    """Steady wind and gusts."""

    steady: Vector3 = quantity((0.0, 0.0, 0.0), unit="m/s", low=-30.0, high=30.0)
    gust_sigma: float = quantity(0.0, unit="m/s", low=0.0, high=10.0)


@dataclass(frozen=True, kw_only=True)
class Disturbance:
    """Differences of the true vehicle from its file."""

    mass_factor: float = quantity(1.0, low=0.5, high=2.0)
    inertia_factor: float = quantity(1.0, low=0.3, high=3.0)
    rotor_thrust_factor: Vector4 = quantity((1.0, 1.0, 1.0, 1.0), low=0.0, high=1.5)
    motor_lag_factor: float = quantity(1.0, low=0.1, high=5.0)
    loop_lag_factor: float = quantity(1.0, low=0.1, high=5.0, doc="of an ideal inner loop; 1 on other vehicles")
    voltage_factor: float = quantity(
        1.0, low=0.5, high=1.2, doc="battery / that of the thrust curve: rotor speed at a firmware's throttle; 1 on other vehicles")
    surface_effect: bool = quantity(False, doc="ground and wall effect near surfaces; needs the vehicle's propeller_radius")


@dataclass(frozen=True, kw_only=True)
class Adhesion:
    """Limits within which the velcro holds: properties of the material, never changed to make a run succeed."""

    normal_speed: tuple[float, float] = quantity((0.2, 1.0), unit="m/s", low=0.0)
    tangential_speed_max: float = quantity(0.6, unit="m/s", above=0.0)
    tilt_error_max_deg: float = quantity(15.0, unit="deg", above=0.0, high=90.0)
    enabled: bool = quantity(True, doc="false: the pad never holds, to test the recovery")


@dataclass(frozen=True, kw_only=True)
class Grip:
    """Tolerances of pose and speed within which the gripper holds a cable."""

    position: float = quantity(0.08, unit="m", above=0.0, doc="gripper to cable axis")
    tilt_deg: float = quantity(10.0, unit="deg", above=0.0)
    speed: float = quantity(0.4, unit="m/s", above=0.0)
    enabled: bool = quantity(True, doc="false: the grip fails, to test the recovery")


@dataclass(frozen=True, kw_only=True)
class Latency:
    """Modelled latency of slow participants, from trigger to use of the result [s] (VIO on the paper's board: 35-45 ms)."""

    vio: float = quantity(0.040, unit="s", low=0.002, high=1.0)
    target_localizer: float = quantity(0.060, unit="s", low=0.002, high=1.0)
    powerline_mapper: float = quantity(0.060, unit="s", low=0.002, high=1.0)
    mission: float = quantity(0.010, unit="s", low=0.002, high=1.0)
    perching_planner: float = quantity(0.040, unit="s", low=0.002, high=5.0, doc="from the request to the use of the plan")
    powerline_planner: float = quantity(1.0, unit="s", low=0.002, high=10.0)


@dataclass(frozen=True, kw_only=True)
class Mission:
    """The goal of the Perch action that a demo sends."""

    type: str = text("", doc="mission, one of perch_control.mission.missions; empty: that of the scenario's mode")
    takeoff_height: float = quantity(1.2, unit="m", above=0.0, high=10.0)
    search_timeout: float = quantity(10.0, unit="s", above=0.0, high=300.0, doc="the target is looked for so long")
    replan: bool = quantity(False)
    attempts: int = quantity(1, low=1, high=10)
    perch_point: Vector3 = quantity((0.0, 0.0, 0.0), unit="m")
    perch_pitch_deg: float = quantity(90.0, unit="deg", low=0.0, high=180.0)
    perception_aware: bool = quantity(False)


@dataclass(frozen=True, kw_only=True)
class Waypoint:
    """A waypoint of an inspection."""

    position: Vector3 = quantity(unit="m", doc="in map")
    yaw_deg: float = quantity(0.0, unit="deg", low=-180.0, high=180.0)


@dataclass(frozen=True, kw_only=True)
class Inspection:
    """Reference of an inspection: straight lines from waypoint to waypoint, at rest at each."""

    waypoints: tuple[Waypoint, ...] = quantity(())
    speed: float = quantity(0.5, unit="m/s", above=0.0, high=5.0, doc="mean speed between waypoints")
    watched: Vector3 = quantity((0.0, 0.0, 0.0), unit="m", doc="rough point on the cable to keep in view, in map")


@dataclass(frozen=True, kw_only=True)
class Scenario:
    """Description of a flight; together with a seed, it determines the flight."""

    name: str = label()
    description: str = text("")
    mode: str = choice("surface", options=("surface", "powerline", "inspection"))
    vehicle: str = text("snapdragon")
    realism: str = choice("default", options=("default", "ideal"), doc="default: calibration errors of the cameras are drawn per seed")
    start: Start = part(Start)
    target: Target = part(Target)
    world: World = part(World)
    wind: Wind = part(Wind)
    disturbance: Disturbance = part(Disturbance)
    adhesion: Adhesion = part(Adhesion)
    grip: Grip = part(Grip)
    inspection: Inspection = part(Inspection)
    latency: Latency = part(Latency)
    mission: Mission = part(Mission)
    time_limit: float = quantity(40.0, unit="s", above=0.0, high=600.0, doc="simulated time after which the flight has failed")
    nodes: tuple[str, ...] = quantity(
        ("vehicle", "vio", "estimator", "target_localizer", "perching_planner", "controller", "mission"))
    parameters: dict[str, dict[str, Any]] = text(None, doc="node -> parameter -> value, over the node's own file")

    def __post_init__(self) -> None:
        for node in self.nodes:
            if node not in NODES:
                raise ConfigError("", "nodes", f"{node!r} is not one of {', '.join(NODES)}")
        for node in self.parameters or {}:
            if node not in NODES:
                raise ConfigError("", f"parameters.{node}", f"is not one of {', '.join(NODES)}")
        for name in (self.parameters or {}).get("vehicle", {}):
            if name in OF_THE_FLIGHT:
                raise ConfigError("", f"parameters.vehicle.{name}", "follows from the scenario itself, the flight's seed and its nodes")
        x, y, z = self.start.position
        if self._outside(np.array(self.start.position)) or z != 0.0:
            raise ConfigError("", "start.position", f"({x:g}, {y:g}, {z:g}) m is not on the floor of the room")
        low, high = self.adhesion.normal_speed
        if not low < high:
            raise ConfigError("", "adhesion.normal_speed", f"[{low:g}, {high:g}] m/s is empty")
        self._check_cables()
        if self.mode == "surface":
            self._check_target()
        if self.mode == "inspection":
            self._check_waypoints()

    def _outside(self, p: np.ndarray) -> bool:
        half = np.array(self.world.room) / 2
        return bool(np.any(np.abs(p - np.array([*self.world.room_centre, half[2]])) > half + 1e-9))

    def _check_cables(self) -> None:
        cables = self.world.cables
        if len(cables) > MAX_CABLES or self.mode == "powerline" and not cables:
            raise ConfigError("", "world.cables", f"has {len(cables)} entries, outside [{int(self.mode == 'powerline')}, {MAX_CABLES}]")
        for k, cable in enumerate(cables):
            chord = math.dist(cable.start, cable.end)
            if cable.sag > chord:
                raise ConfigError("", f"world.cables[{k}].sag", f"{cable.sag:g} m is outside [0, {chord:g}] m, the distance of the ends")
            try:
                cable.catenary()
            except PerchError as error:
                raise ConfigError("", f"world.cables[{k}]", str(error)) from None

    def _check_waypoints(self) -> None:
        waypoints = self.inspection.waypoints
        if len(waypoints) < 2:
            raise ConfigError("", "inspection.waypoints", f"has {len(waypoints)} entries, needs at least 2")
        for k, (x, y, z) in enumerate(w.position for w in waypoints):
            if self._outside(np.array([x, y, z])):
                raise ConfigError("", f"inspection.waypoints[{k}].position", f"({x:g}, {y:g}, {z:g}) m is outside the room")

    def _check_target(self) -> None:
        p = self.surface.p_WS
        if self._outside(p):
            raise ConfigError("", "target", f"pad centre ({p[0]:.2f}, {p[1]:.2f}, {p[2]:.2f}) m is outside the room")
        reach = math.hypot(self.target.distance, self.target.height - self.mission.takeoff_height)
        if reach > 3.6:
            raise ConfigError("", "target.height", f"pad is {reach:.2f} m from the search hover, outside [0.8, 3.6] m that the camera reads")
        if 90.0 < self.target.inclination_deg and self.target.height < self.mission.takeoff_height:
            raise ConfigError("", "target.height", f"{self.target.height:g} m is below the search hover; a ceiling pad must be above it")

    @property
    def mission_type(self) -> str:
        """Name of the mission that is flown."""
        return self.mission.type or self.mode

    @property
    def heading(self) -> float:
        """Direction from the start to the pad in map [rad]."""
        return math.radians(self.start.yaw_deg + self.target.bearing_deg)

    @property
    def surface(self) -> PerchSurface:
        """The true surface, at time zero, in map."""
        c, s = math.cos(self.heading), math.sin(self.heading)
        x, y, z = self.start.position
        p_WS = np.array([x + self.target.distance * c, y + self.target.distance * s, z + self.target.height])
        return PerchSurface.from_inclination(
            p_WS, math.radians(self.target.inclination_deg), self.heading + math.radians(self.target.turn_deg))


def load_scenario(name_or_path: str | Path) -> Scenario:
    """Return the scenario of `config/scenarios/<name>.yaml`, or of a file, merged with the files that it extends.

    Raises:
        ConfigError: no such scenario, or a value that is refused.
    """
    return load_extended(Scenario, "scenarios", name_or_path)
