"""Node `perching_planner`: service `plan_perch`, the QP planner with global bound checking behind messages. [M:IV-C]"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from perch_msgs.msg import Certificate as CertificateMessage
from perch_msgs.msg import Trajectory
from perch_msgs.srv import PlanPerch

from perch_core import config, so3
from perch_core.config import quantity, text
from perch_core.errors import ConfigError, PerchError
from perch_core.ros.conversions import pose_arrays, to_array, to_seconds
from perch_core.ros.node import PerchNode, spin_main
from perch_core.ros.trajectories import flat_message, from_message
from perch_core.surface import PerchSurface
from perch_core.trajectory import FlatTrajectory
from perch_core.vehicle import load_vehicle
from perch_planner import refusals
from perch_planner.certificates import Certificate
from perch_planner.planner import plan
from perch_planner.problem import PerchProblem, PerchSettings, StartState, Waypoint
from perch_planner.refusals import PerchRefusal

_ERROR_CODES = {
    refusals.BAD_INPUT: PlanPerch.Response.BAD_INPUT, refusals.UNREACHABLE_TILT: PlanPerch.Response.UNREACHABLE_TILT,
    refusals.INFEASIBLE_WINDOW: PlanPerch.Response.INFEASIBLE_WINDOW, refusals.THRUST_FLOOR: PlanPerch.Response.THRUST_FLOOR,
    refusals.BOX: PlanPerch.Response.BOX, refusals.BODY_RATE: PlanPerch.Response.BODY_RATE,
    refusals.SOLVER: PlanPerch.Response.SOLVER, refusals.TIME_LIMIT: PlanPerch.Response.TIME_LIMIT,
}
_OBJECTIVES = {PlanPerch.Request.OBJECTIVE_SNAP: "snap", PlanPerch.Request.OBJECTIVE_JERK: "jerk"}


@dataclass(frozen=True, kw_only=True)
class PerchingPlannerParameters(PerchSettings):
    """Parameters of the node: those of the planner, and the vehicle it plans for."""

    vehicle: str = text("snapdragon", doc="config/vehicles/<name>.yaml, or a file")
    contact_time: float = quantity(0.3, unit="s", low=0.0, high=10.0, doc="wait for contact after the end")


class PerchingPlannerNode(PerchNode[PerchingPlannerParameters]):
    """Requests to `plan`, plans and refusals to responses."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("perching_planner", PerchingPlannerParameters, self._change, **kwargs)
        self._vehicle = load_vehicle(self.params.vehicle)
        self._warm_up()
        self._service = self.create_service(PlanPerch, "plan_perch", self._plan)

    def _change(self, value: PerchingPlannerParameters) -> None:
        if value.vehicle != self.params.vehicle:
            raise ConfigError(self.get_name(), "vehicle", "fixed after the start")

    def _warm_up(self) -> None:
        """Plan once, so that the kernels are compiled or loaded before the first request."""
        surface = PerchSurface.from_inclination(np.array([2.0, 0.0, 1.5]), math.radians(60.0))
        try:
            plan(PerchProblem(StartState((0.0, 0.0, 1.5)), surface), self.params, self._vehicle)
        except PerchRefusal as refusal:  # these limits may leave no plan; the kernels are loaded all the same
            self.get_logger().debug(str(refusal))

    def _plan(self, request: PlanPerch.Request, response: PlanPerch.Response) -> PlanPerch.Response:
        try:
            planned = plan(self._problem(request), self._settings(request), self._vehicle)
        except PerchRefusal as refusal:
            response.error_code, response.message = _ERROR_CODES[refusal.code], str(refusal)
            response.certificates = [_message(c) for c in refusal.certificates]
            response.iterations = refusal.iterations
        except PerchError as error:
            response.error_code, response.message = PlanPerch.Response.BAD_INPUT, str(error)
        else:
            response.success, response.message = True, f"contact after {planned.duration:.3f} s"
            trajectory = FlatTrajectory(planned.trajectory.durations, planned.trajectory.coefficients)
            response.trajectory = flat_message(trajectory)
            response.trajectory.header.stamp = request.start_time
            response.trajectory.at_end = Trajectory.AT_END_CONTACT
            response.trajectory.contact_time = float(self.params.contact_time)
            response.certificates = [_message(c) for c in planned.certificates]
            response.iterations, response.solve_time = planned.iterations, float(planned.solve_time)
        if not response.success:
            self.get_logger().warning(f"no plan: {response.message}")
        return response

    def _problem(self, request: PlanPerch.Request) -> PerchProblem:
        """The problem of a request.

        Raises:
            PerchError: values that are not finite, a quaternion that is not one, or a start outside `current`.
        """
        p_WS, q_WS = pose_arrays(request.target)
        norm = float(np.linalg.norm(q_WS))
        if not abs(norm - 1.0) < 1e-3:
            raise ConfigError("request", "target.orientation", f"norm {norm:.4f} is not 1")
        surface = PerchSurface(p_WS, so3.quat_to_matrix(q_WS / norm), (1.0, 1.0))
        if request.from_trajectory:
            current = from_message(request.current)
            if not isinstance(current, FlatTrajectory):
                raise ConfigError("request", "current", "carries samples; a start needs polynomial segments")
            start = StartState.on(current, to_seconds(request.start_time) - current.start_time)
        else:
            start = StartState(to_array(request.start_position), to_array(request.start_velocity),
                               to_array(request.start_acceleration), to_array(request.start_jerk),
                               request.start_yaw, request.start_yaw_rate)
        return PerchProblem(start, surface, tuple(Waypoint(to_array(p)) for p in request.waypoints),
                            to_array(request.target_velocity), tuple(request.segment_times) or None)

    def _settings(self, request: PlanPerch.Request) -> PerchSettings:
        """The node's parameters with the options of a request. NaN leaves a parameter as it is.

        Raises:
            ConfigError: an option is out of its range.
        """
        changes: dict[str, Any] = {}
        for name in ("impact_acceleration", "impact_speed_min", "impact_speed_max", "thrust_max", "thrust_min"):
            value = float(getattr(request, name))
            if not math.isnan(value):
                changes[name] = value
        if request.objective != PlanPerch.Request.OBJECTIVE_DEFAULT:
            if request.objective not in _OBJECTIVES:
                raise ConfigError("request", "objective", f"{request.objective} is not one of {sorted({0, *_OBJECTIVES})}")
            changes["objective"] = _OBJECTIVES[request.objective]
        if request.minimum_time:
            changes["minimum_time"] = True
        try:
            return config.replace(self.params, **changes) if changes else self.params
        except ConfigError as error:
            raise ConfigError("request", error.key, error.problem) from None


def _message(certificate: Certificate) -> CertificateMessage:
    c = certificate
    return CertificateMessage(
        quantity=c.quantity, unit=c.unit, lower_limit=float(c.lower_limit), upper_limit=float(c.upper_limit),
        minimum=float(c.minimum), maximum=float(c.maximum), time_of_minimum=float(c.time_of_minimum),
        time_of_maximum=float(c.time_of_maximum), method=c.method, holds=bool(c.holds))


def create(**kwargs: Any) -> PerchingPlannerNode:
    """The node, for its own process or a composed one."""
    return PerchingPlannerNode(**kwargs)


def main() -> None:
    """Entry point of the executable `perching_planner`."""
    spin_main(create)
