"""Conversion of requests of `plan_powerline` into requests of the planner, and of its plans into responses."""

from __future__ import annotations

from dataclasses import replace
from enum import IntEnum

import numpy as np

from perch_core.errors import ConfigError, PerchError, PlanningRefusal
from perch_core.rotor_model import P, THRUST, V, W, RotorModel, hover_state
from perch_core.values import AtEnd, PowerlinePlan, PowerlinePlanRequest, limits, seconds
from perch_planner.powerline import plan
from perch_planner.powerline.request import PerchPose, PowerlineRequest

SAMPLE_STEP = 0.004   # spacing of the trajectory's points [s]
SAMPLES = 0.8 * limits.SAMPLES_MAX  # about so many points at most, of a plan that lasts long
CONTACT_TIME = 0.1    # how long the grip is awaited after a perch without recovery, where the mission says nothing [s]
POINT_REACH = 3.0
"""Greatest distance of a perch point from its line segment; a point farther away is refused [m]."""


class PowerlinePlanError(IntEnum):
    """Error codes of `PowerlinePlan`, as in perch_msgs/srv/PlanPowerline; the names are those of the refusals in capitals."""

    OK = 0
    BAD_INPUT = 1
    EMPTY_MAP = 2
    PERCH_IN_COLLISION = 3
    START_INVALID = 4
    INFEASIBLE = 5
    DEADLINE = 6
    SOLVER = 7


def check_request(request: PowerlinePlanRequest) -> None:
    """Refuse an invalid request before it is converted.

    Raises:
        ConfigError: a value is out of range; names the field, its value and the range.
    """
    limits.check("request", request)
    if len(request.rotor_thrust) not in (0, 4):
        raise ConfigError("request", "rotor_thrust", f"has {len(request.rotor_thrust)} values, needs 4 or none")
    for (name, limit), value in zip(limits.POSE.items(), request.perch_pose or ()):
        if problem := limit.problem(value):
            raise ConfigError("request", f"perch_pose.{name}", problem)


def planner_request(request: PowerlinePlanRequest, model: RotorModel, wire_offset: float) -> PowerlineRequest:
    """Convert a checked request into one of the planner.

    Args:
        request: checked request of the service.
        model: of the vehicle, for the thrusts of a hover.
        wire_offset: from the wire's axis to the centre of mass along b3 [m].

    Raises:
        PerchError: the values are not a valid request.
    """
    start = hover_state(model, np.asarray(request.p, float), np.asarray(request.q, float))
    start[V], start[W] = request.v, request.w
    if len(request.rotor_thrust):
        start[THRUST] = request.rotor_thrust
    lines = tuple(line.segment for line in request.lines)
    converted = PowerlineRequest(start, lines, int(request.target_line), None, bool(request.perception_aware), bool(request.with_recovery),
                              bool(request.recovery_only))
    if request.recovery_only:
        return converted
    target = converted.target()
    if request.perch_pose is not None:
        perch = PerchPose.at(*request.perch_pose, request.end_velocity)
    else:
        point = np.asarray(request.perch_point, float)
        distance = float(target.distance(point))
        if distance > POINT_REACH:
            raise PlanningRefusal("bad_input", "perch point", POINT_REACH - distance,
                                  f"perch_point {point.tolist()} is {distance:.2f} m from line {target.id} between its ends (allowed {POINT_REACH:g} m)")
        perch = PerchPose.on_line(target, point, float(request.perch_pitch), wire_offset, start[P], request.end_velocity)
    return replace(converted, perch=perch)


def plan_response(found: plan.PowerlinePlan, model: RotorModel, start: int) -> PowerlinePlan:
    """Return the response with a plan.

    Args:
        found: the plan.
        model: of the vehicle, for the accelerations.
        start: stamp of the trajectory's start [ns].
    """
    step = max(SAMPLE_STEP, sum(part.duration for part in found.parts) / SAMPLES)
    trajectory = found.trajectory(model, seconds(start), step).normalised()
    perch, recovery = found.perch, found.recovery
    at_end, recovery_start = AtEnd.CONTACT, -1.0
    if recovery is not None:
        at_end, recovery_start = (AtEnd.HOLD, 0.0) if perch is None else (AtEnd.RECOVER, perch.duration)
    words = ([] if perch is None else [f"perch after {perch.duration:.3f} s"]) + (
        [] if recovery is None else [f"recovery of {recovery.duration:.3f} s"])
    without = f", without recovery: {found.without_recovery}" if found.without_recovery else ""
    return PowerlinePlan(
        success=True, message=", then ".join(words) + without, trajectory=trajectory, at_end=at_end,
        contact_time=0.0 if perch is None else CONTACT_TIME, recovery_start=recovery_start, certificates=found.bounds,
        perch_time=0.0 if perch is None else perch.duration, recovery_time=0.0 if recovery is None else recovery.duration,
        solve_time=0.0 if perch is None else perch.solve_time, recovery_solve_time=0.0 if recovery is None else recovery.solve_time,
        iterations=int(sum(part.iterations for part in found.parts)), solver=found.parts[0].solver)


def refusal_response(error: Exception) -> PowerlinePlan:
    """Return the response without a plan.

    Args:
        error: a `PlanningRefusal`, the exception that ended the job, or the error of an invalid request.
    """
    if isinstance(error, PlanningRefusal):
        code = PowerlinePlanError[error.code.upper()]
    elif isinstance(error, ConfigError) or type(error) is PerchError:  # a line without length
        code = PowerlinePlanError.BAD_INPUT
    else:
        code = PowerlinePlanError.SOLVER
    return PowerlinePlan(success=False, error_code=code, message=str(error))
