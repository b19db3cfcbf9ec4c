"""Perching planner component: answers requests of `plan_perch` and `plan_way_out` with plans or typed refusals. [M:IV-C]"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from enum import IntEnum
from functools import partial
from typing import Any

import numpy as np

from perch_core import config, so3
from perch_core.component import Component, Diagnostics, Service
from perch_core.config import quantity, text
from perch_core.errors import ConfigError, PerchError
from perch_core.job import Job, JobStopped
from perch_core.surface import PerchSurface
from perch_core.trajectory import FlatTrajectory, rest_to_rest
from perch_core.values import PerchPlan, PerchPlanRequest, limits, seconds
from perch_core.values.planning import OPTIONS
from perch_core.vehicle import Vehicle, load_vehicle
from perch_planner import planner, refusals
from perch_planner.problem import PerchParameters, PerchProblem, PerchSettings, StartState, Waypoint
from perch_planner.refusals import PerchRefusal
from perch_planner.way_out import plan_way_out

CONTACT_TIME = 0.3  # how long a contact is awaited after the end of a plan, where the mission says nothing [s]
OBJECTIVES = {4: "snap", 3: "jerk"}
Method = Callable[[PerchProblem, PerchSettings, Vehicle], planner.PerchPlan]


class PerchPlanError(IntEnum):
    """Error codes of `PerchPlan`, as in perch_msgs/srv/PlanPerch; the names are those of the refusals in capitals."""

    OK = 0
    BAD_INPUT = 1
    UNREACHABLE_TILT = 2
    INFEASIBLE_WINDOW = 3
    THRUST_FLOOR = 4
    BOX = 5
    BODY_RATE = 6
    SOLVER = 7
    TIME_LIMIT = 8


TIME_LIMIT_MAX = 45.0  # largest `time_limit`: less than a client waits for an answer [s]


@dataclass(frozen=True, kw_only=True)
class PerchingPlannerParameters(PerchParameters):
    """Parameters of the component: those of the planner, and the vehicle it plans for."""

    vehicle: str = text("snapdragon", doc="config/vehicles/<name>.yaml, or a file")
    time_limit: float = quantity(2.0, unit="s", above=0.0, high=TIME_LIMIT_MAX, doc="wall-clock limit of a plan, from the request on")

    @property
    def settings(self) -> PerchSettings:
        """Parameters of the planner as settings of a plan."""
        return PerchSettings(**{field.name: getattr(self, field.name) for field in fields(PerchParameters)})


class PerchingPlanner(Component[PerchingPlannerParameters]):
    """Plans perches; each plan is a job that the host may run in another process."""

    config_type = PerchingPlannerParameters
    changeable = tuple(field.name for field in fields(PerchingPlannerParameters) if field.name != "vehicle")

    plan_perch = Service(PerchPlanRequest, PerchPlan, "plan_perch")
    plan_way_out = Service(PerchPlanRequest, PerchPlan, "plan_way_out")

    def __init__(self, config: PerchingPlannerParameters) -> None:
        super().__init__(config)
        self._vehicle = load_vehicle(config.vehicle)

    def warm_up(self) -> None:
        """Load or compile what samples `current` in a request."""
        StartState.on(rest_to_rest(np.zeros(3), np.zeros(3), 0.0, 0.0, 1.0), 0.0)

    def preload(self) -> Callable[[], None]:
        """Return the function that loads or compiles the kernels."""
        return partial(_warm_up, self.config.settings, self._vehicle)

    def on_plan_perch(self, request: PerchPlanRequest, reply: Callable[[PerchPlan], None]) -> None:
        """Plan a perch, and reply with the plan or a refusal."""
        self._plan(planner.plan, request, reply)

    def on_plan_way_out(self, request: PerchPlanRequest, reply: Callable[[PerchPlan], None]) -> None:
        """Plan from the start to a hover in front of the surface.

        Waypoints, segment times and impact options are validated as for a perch, but ignored."""
        self._plan(plan_way_out, request, reply)

    def _plan(self, method: Method, request: PerchPlanRequest, reply: Callable[[PerchPlan], None]) -> None:
        limit = self.config.time_limit
        respond = partial(self._reply, method is planner.plan, request, reply, limit)
        try:
            limits.check("request", request)
            problem = perch_problem(request)
            arguments = (method, problem, perch_settings(request, self.config.settings), perch_vehicle(request, self._vehicle))
        except PerchError as error:
            respond(error)
            return
        self.work(Job(solve, arguments, respond, limit, isolated=True))

    def _reply(self, perch: bool, request: PerchPlanRequest, reply: Callable[[PerchPlan], None], limit: float, found: Any) -> None:
        """Reply with a plan, or with the error that occurred instead."""
        if isinstance(found, planner.PerchPlan):
            answer = perch_plan(found, request, CONTACT_TIME if perch else 0.0)
        else:
            answer = refusal_response(found, limit)
            if perch:  # near the contact, ways out are refused one after the other
                self.warn(f"no plan: {answer.message}")
        self.diagnostics(Diagnostics(limits.stamp_of(request), {
            "success": answer.success, "error_code": int(answer.error_code), "iterations": answer.iterations,
            "solve_ms": 1e3 * answer.solve_time}))
        reply(answer)


def _warm_up(settings: PerchSettings, vehicle: Vehicle) -> None:
    """Plan once with each method, so that the kernels are compiled before the first request; limits of the place do not apply."""
    settings = replace(settings, height_min=-1e4, height_max=1e4, clearance_min=0.0)
    surface = PerchSurface.from_inclination(np.array([2.0, 0.0, 1.5]), math.radians(60.0))
    try:
        for method in (planner.plan, plan_way_out):
            method(PerchProblem(StartState(np.array([0.0, 0.0, 1.5])), surface), settings, vehicle)
    except PerchRefusal:  # the other limits may permit no plan; the kernels are compiled all the same
        pass


def solve(method: Method, problem: PerchProblem, settings: PerchSettings, vehicle: Vehicle) -> planner.PerchPlan:
    """Plan by `planner.plan` or `plan_way_out`, as the job of a request.

    Raises:
        PerchRefusal: no plan was found; code `solver` after an unexpected error.
    """
    try:
        return method(problem, settings, vehicle)
    except (PerchError, MemoryError):
        raise
    except Exception as error:  # every request must be answered
        raise PerchRefusal(refusals.SOLVER, "numerics", -math.inf, f"planning failed: {type(error).__name__}: {error}") from error


def perch_problem(request: PerchPlanRequest) -> PerchProblem:
    """Convert a request into a planning problem.

    Raises:
        ConfigError: `current` carries samples or is out of range, or the start lies outside it.
    """
    norm = float(np.linalg.norm(request.q_WS))  # what is normalised already stays as it is to the last bit
    q_WS = np.asarray(request.q_WS, float) / (norm if abs(norm - 1.0) > 1e-9 else 1.0)
    surface = PerchSurface(np.asarray(request.p_WS, float), so3.quat_to_matrix(q_WS), (1.0, 1.0))
    if request.current is not None:
        current = request.current
        if not isinstance(current, FlatTrajectory):
            raise ConfigError("request", "current", "carries samples; a start needs polynomial segments")
        limits.check("request: current", current, limits.CURRENT)
        start = StartState.on(current, seconds(request.start) - current.start_time)
        limits.check("request: current", start, limits.STATE)
    else:
        start = StartState(request.p, request.v, request.a, request.j, request.yaw, request.yaw_rate)
    return PerchProblem(start, surface, tuple(Waypoint(p) for p in request.waypoints), request.target_velocity,
                        tuple(request.segment_times) or None)


def perch_settings(request: PerchPlanRequest, settings: PerchSettings) -> PerchSettings:
    """Return the settings with the options of a request applied.

    Raises:
        ConfigError: an option is out of its range.
    """
    changes: dict[str, Any] = {name: float(value) for name in OPTIONS if (value := getattr(request, name)) is not None}
    if request.objective:
        if request.objective not in OBJECTIVES:
            raise ConfigError("request", "objective", f"{request.objective} is not one of {sorted({0, *OBJECTIVES})}")
        changes["objective"] = OBJECTIVES[request.objective]
    if request.minimum_time:
        changes["minimum_time"] = True
    if "impact_acceleration" in changes:
        changes["impact_acceleration_fixed"] = True
    try:
        return config.replace(settings, **changes) if changes else settings
    except ConfigError as error:
        raise ConfigError("request", error.key, error.problem) from None


def perch_vehicle(request: PerchPlanRequest, vehicle: Vehicle) -> Vehicle:
    """Return the vehicle with the thrust ratio of a request.

    Raises:
        ConfigError: with this ratio it cannot fly.
    """
    try:
        return vehicle.with_thrust_ratio(request.thrust_ratio or 1.0)
    except ConfigError as error:
        raise ConfigError("request", "thrust_ratio", f"{request.thrust_ratio:g}: {error.problem}") from None


def perch_plan(found: planner.PerchPlan, request: PerchPlanRequest, contact_time: float) -> PerchPlan:
    """Return the response with a plan; contact_time: time-out for the contact after its end [s], 0: it ends in a hover."""
    trajectory = FlatTrajectory(found.trajectory.durations, found.trajectory.coefficients, seconds(request.start))
    return PerchPlan(
        success=True, message=f"{'contact' if contact_time else 'hovering'} after {found.duration:.3f} s", trajectory=trajectory, contact_time=contact_time,
        certificates=found.certificates, iterations=found.iterations, solve_time=float(found.solve_time))


def refusal_response(error: Exception, limit: float) -> PerchPlan:
    """Return the response without a plan.

    Args:
        error: a `PerchRefusal`, the exception that ended the job, or the error of an invalid request.
        limit: wall-clock limit of the plan [s].
    """
    if isinstance(error, PerchRefusal):
        return PerchPlan(success=False, error_code=PerchPlanError[error.code.upper()], message=str(error),
                         certificates=error.certificates, iterations=error.iterations)
    if isinstance(error, JobStopped):
        return PerchPlan(success=False, error_code=PerchPlanError.TIME_LIMIT,
                         message=f"no plan within time_limit {limit:g} s ({error}); request fewer waypoints or raise time_limit")
    if isinstance(error, ConfigError):
        return PerchPlan(success=False, error_code=PerchPlanError.BAD_INPUT, message=str(error))
    return PerchPlan(success=False, error_code=PerchPlanError.SOLVER, message=str(error))
