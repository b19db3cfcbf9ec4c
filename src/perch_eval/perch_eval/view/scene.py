"""Markers of a flight in `map`: vehicle, pad, cables, planned and flown path, waypoints."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence

import numpy as np

from perch_core import so3
from perch_core.trajectory import FlatTrajectory, SampledTrajectory
from perch_core.urdf import ROTOR_RADIUS
from perch_core.values import Marker, OdometryState, PowerlineMap, Shape
from perch_core.vehicle import Vehicle
from perch_sim.scenario import Scenario

Colour = tuple[float, float, float, float]
Floats = tuple[float, ...]
Vector = Sequence[float] | np.ndarray
_ORIGIN, _UPRIGHT = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)
ESTIMATE, TRUTH, PLANNED, FOUND = (1.0, 0.6, 0.1, 1.0), (0.3, 0.6, 0.9, 1.0), (0.2, 0.8, 0.3, 1.0), (0.95, 0.9, 0.2, 1.0)
ROOM, SURFACE, PAD, GHOST = (0.6, 0.6, 0.6, 0.4), (0.55, 0.55, 0.55, 0.5), (0.95, 0.95, 0.95, 1.0), (0.3, 0.6, 0.9, 0.35)
CABLES = {"red": (0.75, 0.1, 0.1, 1.0), "grey": (0.45, 0.45, 0.45, 1.0)}
ROTORS = ((0.9, 0.2, 0.2, 0.8), (0.25, 0.25, 0.25, 0.8), (0.25, 0.25, 0.25, 0.8), (0.9, 0.2, 0.2, 0.8))  # the front ones are red
TEXT_COLOUR = (1.0, 1.0, 1.0, 1.0)
PLAN_STEP = 0.02     # between drawn points of a plan [s]
PATH_STEP = 0.02     # least distance between drawn points of a flown path [m]
PATH_POINTS = 3000   # of a flown path; then every other one is dropped
CAMERA_AXIS_LENGTH = 0.4  # [m]


def _floats(values: Iterable[float]) -> Floats:
    return tuple(float(v) for v in values)


def marker(shape: Shape, ns: str, id: int, colour: Colour, scale: Vector, p: Vector, q: Vector = _UPRIGHT) -> Marker:
    """A shape at a pose in `map`."""
    return Marker(shape, ns, id, colour, _floats(scale), _floats(p), _floats(q))


def polyline(ns: str, id: int, colour: Colour, width: float, points: Iterable[Vector], pieces: bool = False) -> Marker:
    """Return a line through points in `map` [m], or (`pieces`) one per pair of points; fewer than two points delete it."""
    shape, corners = Shape.LINE_LIST if pieces else Shape.LINE_STRIP, tuple(_floats(p) for p in points)
    if len(corners) < 2:
        return removed(shape, ns, id)
    return Marker(shape, ns, id, colour, (float(width), 0.0, 0.0), points=corners)


def removed(shape: Shape, ns: str, id: int) -> Marker:
    """Return the deletion of a marker."""
    return Marker(shape, ns, id, (0.0, 0.0, 0.0, 0.0), _ORIGIN, removed=True)


def arrow(ns: str, id: int, colour: Colour, start: Vector, end: Vector) -> Marker:
    """An arrow between two points in `map`."""
    return Marker(Shape.ARROW, ns, id, colour, (0.02, 0.05, 0.08), points=(_floats(start), _floats(end)))


def label(ns: str, id: int, colour: Colour, height: float, p: Vector, text: str) -> Marker:
    """A text that always faces the viewer; its letters are `height` high [m]."""
    return Marker(Shape.TEXT, ns, id, colour, (0.0, 0.0, height), _floats(p), text=text)


def box_edges(low: np.ndarray, high: np.ndarray) -> list[np.ndarray]:
    """Return the end points of the twelve edges of a box, for a `polyline` with `pieces`."""
    corners = np.array(np.meshgrid(*zip(low, high), indexing="ij")).reshape(3, 8).T
    pairs = [(a, b) for a in range(8) for b in range(a) if np.count_nonzero(corners[a] != corners[b]) == 1]
    return [corners[k] for pair in pairs for k in pair]


class Path:
    """A flown path that does not grow without bound."""

    def __init__(self) -> None:
        self.points: list[tuple[float, ...]] = []

    def add(self, p: Sequence[float]) -> None:
        """Add a position if it is far enough from the last one."""
        if self.points and max(abs(a - b) for a, b in zip(p, self.points[-1])) < PATH_STEP:
            return
        self.points.append(tuple(p))
        if len(self.points) > PATH_POINTS:
            self.points = self.points[::2]


def world_markers(scenario: Scenario) -> list[Marker]:
    """Return the static markers: room, surface with pad, true cables, waypoints."""
    world = scenario.world
    half = np.array([world.room[0] / 2, world.room[1] / 2])
    low, high = (np.array([*(np.array(world.room_centre) + sign * half), z]) for sign, z in ((-1, 0.0), (1, world.room[2])))
    out = [polyline("room", 0, ROOM, 0.02, box_edges(low, high), pieces=True)]
    if scenario.mode == "surface":
        surface = scenario.surface
        q = so3.quat_from_matrix(surface.R_WS)
        out.append(marker(Shape.CUBE, "surface", 0, SURFACE, (*scenario.target.panel_size, 0.02), surface.p_WS - 0.02 * surface.normal, q))
        out.append(marker(Shape.CUBE, "pad", 0, PAD, (*surface.size, 0.01), surface.p_WS - 0.005 * surface.normal, q))
    for k, cable in enumerate(world.cables):
        out.append(polyline("cables", k, CABLES[cable.colour], 2 * cable.radius, cable.catenary().sample(2 if cable.sag == 0.0 else 40)))
    if scenario.mode == "inspection":
        points = [w.position for w in scenario.inspection.waypoints]
        out.append(polyline("waypoints", 0, PLANNED, 0.01, points))
        for k, p in enumerate(points):
            out += [marker(Shape.SPHERE, "waypoints", 2 * k + 1, PLANNED, (0.08, 0.08, 0.08), p),
                    label("waypoints", 2 * k + 2, TEXT_COLOUR, 0.15, (p[0], p[1], p[2] + 0.15), str(k + 1))]
    return out


def vehicle_markers(vehicle: Vehicle, state: OdometryState, text: str) -> list[Marker]:
    """Return the vehicle at its estimated pose: rotors (the front ones red), thrust axis, camera axis, text above it."""
    p, R = np.array(state.p_WB), so3.quat_to_matrix(np.array(state.q_WB))
    hubs = [p + R @ np.array([x, y, 0.0]) for x, y in vehicle.rotor_xy]
    out = [polyline("vehicle", 0, ESTIMATE, 0.02, [hubs[0], hubs[2], hubs[1], hubs[3]], pieces=True)]
    size = 2 * (vehicle.propeller_radius or ROTOR_RADIUS)
    out += [marker(Shape.CYLINDER, "vehicle", 1 + k, ROTORS[k], (size, size, 0.01), hub, state.q_WB)
            for k, hub in enumerate(hubs)]
    out.append(arrow("vehicle", 5, ESTIMATE, p, p + 0.3 * R[:, 2]))
    mount = vehicle.mounts.get("front")
    if mount is not None:
        eye = p + R @ mount.p_BC
        out.append(arrow("camera_axis", 0, PLANNED, eye, eye + CAMERA_AXIS_LENGTH * R @ mount.R_BC[:, 2]))
    out.append(label("status", 0, TEXT_COLOUR, 0.12, p + (0.0, 0.0, 0.35), text))
    return out


def truth_markers(vehicle: Vehicle, state: OdometryState) -> list[Marker]:
    """Return the vehicle's ellipsoid at its true pose."""
    return [marker(Shape.SPHERE, "truth", 0, GHOST, 2 * np.array(vehicle.body_radii), state.p_WB, state.q_WB)]


def target_markers(p: np.ndarray, q: np.ndarray) -> list[Marker]:
    """The pad as localised, with its normal."""
    normal = so3.quat_to_matrix(q)[:, 2]
    return [marker(Shape.CUBE, "target", 0, (*FOUND[:3], 0.5), (0.6, 0.6, 0.015), p, q), arrow("target", 1, FOUND, p, p + 0.3 * normal)]


def _map_id(line: int) -> int:
    """Return the marker's id of a mapped cable, in the range of the message; the next one is that of its text."""
    return 2 * line % 2**31


def map_markers(lines: PowerlineMap, before: Collection[int]) -> list[Marker]:
    """Return the cables as mapped, with their ids; ids of `before` that are not in the map are deleted."""
    out = []
    for id in sorted(set(before) - {line.id for line in lines.lines}):
        out += [removed(Shape.LINE_STRIP, "map", _map_id(id)), removed(Shape.TEXT, "map", _map_id(id) + 1)]
    for line in lines.lines:
        start, end = np.array(line.start), np.array(line.end)
        out += [polyline("map", _map_id(line.id), FOUND, 2 * max(line.radius, 0.01), (start, end)),
                label("map", _map_id(line.id) + 1, FOUND, 0.12, (start + end) / 2 + (0.0, 0.0, 0.12), f"{line.id}")]
    return out


def plan_markers(trajectory: FlatTrajectory | SampledTrajectory, ends_in_contact: bool) -> list[Marker]:
    """Return a trajectory given to the controller; its end point is red if it ends in a contact."""
    if isinstance(trajectory, FlatTrajectory):
        points = trajectory.sample_many(np.arange(0.0, trajectory.duration, PLAN_STEP)).p
    else:
        points = trajectory.p[::max(1, round(PLAN_STEP / max(float(np.diff(trajectory.times).mean()), 1e-6)))]
    colour = CABLES["red"] if ends_in_contact else PLANNED
    return [polyline("plan", 0, PLANNED, 0.015, points), marker(Shape.SPHERE, "plan", 1, colour, (0.06, 0.06, 0.06), points[-1])]


def path_markers(estimate: Path, truth: Path) -> list[Marker]:
    """Return the flown path, estimated and true."""
    return [polyline("flown", 0, ESTIMATE, 0.012, estimate.points), polyline("flown", 1, TRUTH, 0.008, truth.points)]
