"""Validation of requests: refusals before any solver runs, with the cause and what to change."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np

from perch_core import so3
from perch_core.errors import PlanningRefusal
from perch_core.lines import Segment, scaled_clearance, segment_distance
from perch_core.rotor_model import P, Q, THRUST, V, W
from perch_core.vehicle import GRAVITY, Vehicle
from perch_planner.powerline.request import PerchPose, PowerlineRequest
from perch_planner.powerline.settings import PowerlineSettings

END_TRIM = 0.1  # neighbours of one cable touch at their ends: that much of each end does not count as crossing [m]
CROSSING_COSINE = 0.966  # 15 deg: two estimates of one cable may overlap, lines that cross are a wrong map
BEARING_MAX = 120.0  # a perch point farther from the camera's heading is behind the vehicle [deg]
GRIPPER_ERROR_MAX = 0.05  # a given perch pose brings the gripper this near to the line [m]
SPEED_MAX = 10.0  # no start of a perch is faster [m/s]


def check_request(request: PowerlineRequest, vehicle: Vehicle, settings: PowerlineSettings) -> PerchPose | None:
    """Refuse a request that cannot be planned; return the perch pose, None for a recovery alone.

    Raises:
        PlanningRefusal: code bad_input, empty_map, start_invalid or perch_in_collision; the message names the value.
    """
    if np.shape(request.start) != (17,):
        raise PlanningRefusal("bad_input", "start state", -1.0, f"start state has shape {np.shape(request.start)}, needs (17,)")
    _check_finite({"start state": request.start, "hover": np.zeros(3) if request.hover is None else request.hover})
    norm = float(np.linalg.norm(request.start[Q]))
    if abs(norm - 1) > 1e-2:
        raise PlanningRefusal("bad_input", "start attitude", -abs(norm - 1), f"start quaternion has norm {norm:.4f}, not 1")
    if len({line.id for line in request.lines}) < len(request.lines):
        raise PlanningRefusal("bad_input", "line ids", -1.0, "two lines have the same id")
    if request.recovery_only:
        _check_start(request, vehicle, settings)
        return None  # a recovery starts at a line
    pose, target = request.perch, request.target()
    if pose is None:
        raise PlanningRefusal("bad_input", "perch pose", -1.0, "no perch pose is given")
    _check_finite({"perch position": pose.p_WB, "perch direction": pose.s3_W, "end velocity": pose.v_W})
    _check_crossings(request.lines)
    _check_start(request, vehicle, settings)
    _check_clearance(request, vehicle)
    _check_perch(request, pose, target, vehicle, settings)
    _check_bearing(request, pose, target, vehicle, settings)
    return pose


def _check_finite(values: dict[str, np.ndarray]) -> None:
    for name, value in values.items():
        if not np.all(np.isfinite(value)):
            raise PlanningRefusal("bad_input", name, -1.0, f"{name} {np.asarray(value).tolist()} is not finite")


def _check_crossings(lines: tuple[Segment, ...]) -> None:
    trimmed = {line.id: replace(line, half_length=max(line.half_length - END_TRIM, 1e-3)) for line in lines}
    for a, b in combinations(trimmed.values(), 2):
        gap = segment_distance(a, b) - a.radius - b.radius
        if gap < 0 and abs(a.direction @ b.direction) < CROSSING_COSINE:
            raise PlanningRefusal("bad_input", "lines cross", gap,
                                  f"lines {a.id} and {b.id} cross: their axes come within {segment_distance(a, b):.3f} m; the map is wrong")


def _check_start(request: PowerlineRequest, vehicle: Vehicle, settings: PowerlineSettings) -> None:
    start = request.start
    if start[2] < settings.height_min:
        raise PlanningRefusal("start_invalid", "height [P:eq14e]", start[2] - settings.height_min,
                              f"start height {start[2]:.3f} m is below height_min {settings.height_min:g} m; climb first")
    rate, speed = float(np.linalg.norm(start[W])), float(np.linalg.norm(start[V]))
    if rate > vehicle.body_rate_max:
        raise PlanningRefusal("start_invalid", "body rate", vehicle.body_rate_max - rate,
                              f"start body rate {rate:.2f} rad/s is above {vehicle.body_rate_max:g} rad/s")
    if speed > SPEED_MAX:
        raise PlanningRefusal("start_invalid", "speed", SPEED_MAX - speed, f"start speed {speed:.2f} m/s is above {SPEED_MAX:g} m/s")
    low, high = start[THRUST].min(), start[THRUST].max()
    if low < -1e-6 or high > 1.05 * vehicle.thrust_max:
        raise PlanningRefusal("start_invalid", "rotor thrust [P:eq14f]", min(low, vehicle.thrust_max - high),
                              f"start rotor thrusts {low:.2f} .. {high:.2f} N are outside [0, {vehicle.thrust_max:.2f}] N")


def _check_clearance(request: PowerlineRequest, vehicle: Vehicle) -> None:
    for line in request.lines:
        clearance = float(scaled_clearance(request.start[None, P], request.start[None, Q], line, vehicle.body_radii)[0])
        if clearance < 0:
            raise PlanningRefusal("start_invalid", "clearance [P:eq14j]", clearance,
                                  f"line {line.id} is nearer than the body at the start: scaled distance {1 + clearance:.2f} < 1; move away first")


def _check_perch(request: PowerlineRequest, perch: PerchPose, target: Segment, vehicle: Vehicle, settings: PowerlineSettings) -> None:
    if abs(np.linalg.norm(perch.s3_W) - 1) > 1e-3:
        raise PlanningRefusal("bad_input", "perch direction", -1.0, "the requested direction of b3 is not a unit vector")
    if perch.p_WB[2] < settings.height_min:
        raise PlanningRefusal("infeasible", "height [P:eq14e]", perch.p_WB[2] - settings.height_min,
                              f"perch height {perch.p_WB[2]:.3f} m is below height_min {settings.height_min:g} m")
    duration_max, acceleration_max = settings.duration[1], 4.0 * vehicle.thrust_max / vehicle.mass + GRAVITY  # all thrust and gravity in one direction
    reach = float(np.linalg.norm(request.start[V])) * duration_max + 0.5 * acceleration_max * duration_max**2
    distance = float(np.linalg.norm(perch.p_WB - request.start[P]))
    if distance > reach:
        raise PlanningRefusal("infeasible", "duration", reach - distance,
                              f"the perch is {distance:.1f} m away; in {duration_max:g} s no more than {reach:.1f} m can be flown; start nearer")
    for line in request.lines:
        clearance = float(scaled_clearance(perch.p_WB[None], perch.q_WB[None], line, vehicle.body_radii)[0])
        if clearance < 0:
            raise PlanningRefusal("perch_in_collision", "clearance [P:eq14j]", clearance,
                                  f"at the perch pose the body cuts line {line.id}: scaled distance {1 + clearance:.2f} < 1")
    gripper_error = float(target.distance(perch.p_WB - vehicle.wire_offset * perch.s3_W))
    if gripper_error > GRIPPER_ERROR_MAX:
        raise PlanningRefusal("bad_input", "gripper", GRIPPER_ERROR_MAX - gripper_error,
                              f"at the perch pose the gripper is {gripper_error:.3f} m off line {target.id} (allowed {GRIPPER_ERROR_MAX:g} m)")


def _check_bearing(request: PowerlineRequest, perch: PerchPose, target: Segment, vehicle: Vehicle, settings: PowerlineSettings) -> None:
    axis_W = so3.quat_to_matrix(request.start[Q]) @ vehicle.mounts[settings.camera].R_BC[:, 2]
    way = target.closest_point(perch.p_WB) - request.start[P]
    bearing = float(np.degrees(so3.angle_between(axis_W, way)))
    if bearing > BEARING_MAX:
        raise PlanningRefusal("bad_input", "line ahead", BEARING_MAX - bearing,
                              f"line {target.id} is behind the vehicle: {bearing:.0f} deg from the camera's axis "
                              f"(allowed {BEARING_MAX:g} deg); turn to face it first")
