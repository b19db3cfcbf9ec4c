"""Node `powerline_planner`: service `plan_powerline`, the powerline NLP behind messages. [P:V]"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from perch_msgs.msg import Certificate, Powerline, Trajectory
from perch_msgs.srv import PlanPowerline

from perch_core.config import quantity, text
from perch_core.errors import ConfigError, PerchError, PlanningRefusal
from perch_core.lines import Segment
from perch_core.ros.conversions import pose_arrays, to_array
from perch_core.ros.node import PerchNode, spin_main
from perch_core.ros.trajectories import sampled_message
from perch_core.rotor_model import P, THRUST, V, W, RotorModel, hover_state
from perch_core.vehicle import load_vehicle
from perch_planner.powerline.certificate import Bound
from perch_planner.powerline.plan import PowerlinePlan
from perch_planner.powerline.request import PerchPose, PowerlineRequest
from perch_planner.powerline.settings import PowerlineSettings
from perch_planner.powerline.worker import START_TIMEOUT, PowerlineWorker

_RESPONSE = PlanPowerline.Response
_ERROR_CODES = {
    "bad_input": _RESPONSE.BAD_INPUT, "empty_map": _RESPONSE.EMPTY_MAP, "perch_in_collision": _RESPONSE.PERCH_IN_COLLISION,
    "start_invalid": _RESPONSE.START_INVALID, "infeasible": _RESPONSE.INFEASIBLE, "deadline": _RESPONSE.DEADLINE,
    "solver": _RESPONSE.SOLVER,
}


@dataclass(frozen=True, kw_only=True)
class PowerlinePlannerParameters(PowerlineSettings):
    """Parameters of the node: those of the planner, the vehicle it plans for, and how finely it answers."""

    vehicle: str = text("rpg", doc="config/vehicles/<name>.yaml, or a file")
    sample_step: float = quantity(0.004, unit="s", low=0.001, high=0.05, doc="spacing of the trajectory's points")
    contact_time: float = quantity(0.1, unit="s", low=0.0, high=10.0, doc="wait for the grip after a perch without recovery")


class PowerlinePlannerNode(PerchNode[PowerlinePlannerParameters]):
    """Requests to the planning process, plans and refusals to responses.

    The service appears when the planning process is ready: the first time on a machine it compiles for some 15 s. A call
    blocks this node until its deadline at most.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("powerline_planner", PowerlinePlannerParameters, **kwargs)
        self._vehicle = load_vehicle(self.params.vehicle)
        if self.params.camera not in self._vehicle.mounts:
            raise ConfigError(self.get_name(), "camera", f"vehicle {self._vehicle.name} has no camera {self.params.camera!r}")
        if not math.isfinite(self._vehicle.thrust_rate_max):
            raise ConfigError(self.get_name(), "vehicle", f"{self._vehicle.name} has no thrust_rate_max, which [P:eq14g] needs")
        self._model = RotorModel.of(self._vehicle)
        self._worker = PowerlineWorker(self._vehicle, self.params)
        try:
            if not self._worker.wait_ready():
                raise ConfigError(self.get_name(), "", f"the planning process was not ready after {START_TIMEOUT:g} s")
        except PerchError:
            self.close()
            raise
        self._service = self.create_service(PlanPowerline, "plan_powerline", self._plan)

    def close(self) -> None:
        """End the planning process."""
        self._worker.close()

    def destroy_node(self) -> None:
        """End the planning process with the node, also where no main loop calls `close`."""
        if hasattr(self, "_worker"):
            self.close()
        super().destroy_node()

    def _plan(self, request: PlanPowerline.Request, response: PlanPowerline.Response) -> PlanPowerline.Response:
        try:
            deadline = float(request.deadline) if request.deadline != 0 else self.params.deadline
            if not math.isfinite(deadline):
                raise PlanningRefusal("bad_input", "deadline", -1.0, f"deadline {deadline} s is not finite")
            plan = self._worker.plan(self._request(request), deadline)
        except PlanningRefusal as refusal:
            response.error_code, response.message = _ERROR_CODES[refusal.code], str(refusal)
        except PerchError as error:
            response.error_code, response.message = _RESPONSE.BAD_INPUT, str(error)
        else:
            self._fill(response, plan)
            response.trajectory.header.stamp = request.start_time
        if not response.success:
            self.get_logger().warning(f"no plan: {response.message}")
        return response

    def _request(self, msg: PlanPowerline.Request) -> PowerlineRequest:
        """The planner's request of a message.

        Raises:
            PerchError: values that cannot be a request.
        """
        p_WB, q_WB = pose_arrays(msg.start_pose)
        norm = float(np.linalg.norm(q_WB))
        if not abs(norm - 1.0) < 1e-2:
            raise PlanningRefusal("bad_input", "start attitude", -1.0, f"start quaternion has norm {norm:.4f}, not 1")
        start = hover_state(self._model, p_WB, q_WB)
        start[V], start[W] = to_array(msg.start_velocity), to_array(msg.start_angular_velocity)
        if len(msg.start_rotor_thrust) == 4:
            start[THRUST] = list(msg.start_rotor_thrust)
        elif len(msg.start_rotor_thrust):
            raise PlanningRefusal("bad_input", "rotor thrusts", -1.0,
                                  f"start_rotor_thrust has {len(msg.start_rotor_thrust)} values, needs 4 or none")
        lines = tuple(_segment(line) for line in msg.lines)
        request = PowerlineRequest(start, lines, int(msg.target_line), None, bool(msg.perception_aware),
                                   bool(msg.with_recovery), bool(msg.recovery_only))
        if msg.recovery_only:
            return request
        velocity = to_array(msg.end_velocity)
        target = request.target()
        if msg.use_pose:
            perch = PerchPose.at(*pose_arrays(msg.perch_pose), velocity)
        else:
            point = to_array(msg.perch_point)
            if not np.all(np.isfinite(point)):
                raise PlanningRefusal("bad_input", "perch point", -1.0, f"perch point {point.tolist()} is not finite")
            perch = PerchPose.on_line(target, point, float(msg.perch_pitch), self._vehicle.perch_offset, start[P], velocity)
        return PowerlineRequest(start, lines, request.target_line, perch, request.perception, request.with_recovery)

    def _fill(self, response: PlanPowerline.Response, plan: PowerlinePlan) -> None:
        trajectory = plan.trajectory(self._model, step=self.params.sample_step)
        response.success = True
        response.trajectory = sampled_message(trajectory)
        message = []
        if plan.perch is not None:
            response.perch_time, response.solve_time = float(plan.perch.duration), float(plan.perch.solve_time)
            response.trajectory.at_end = Trajectory.AT_END_CONTACT
            response.trajectory.contact_time = float(self.params.contact_time)
            message.append(f"perch after {plan.perch.duration:.3f} s")
        if plan.recovery is not None:
            response.recovery_time = float(plan.recovery.duration)
            response.recovery_solve_time = float(plan.recovery.solve_time)
            response.trajectory.at_end = Trajectory.AT_END_HOLD if plan.perch is None else Trajectory.AT_END_RECOVER
            response.trajectory.recovery_start = 0.0 if plan.perch is None else float(plan.perch.duration)
            message.append(f"recovery of {plan.recovery.duration:.3f} s")
        response.message = ", then ".join(message)
        response.certificates = [_certificate(bound) for bound in plan.bounds]
        response.iterations = int(sum(part.iterations for part in plan.parts))
        response.solver = plan.parts[0].solver


def _segment(line: Powerline) -> Segment:
    return Segment.between(to_array(line.start), to_array(line.end), float(line.radius), int(line.id))


def _certificate(bound: Bound) -> Certificate:
    return Certificate(
        quantity=bound.quantity, unit=bound.unit, lower_limit=bound.lower_limit, upper_limit=bound.upper_limit,
        minimum=bound.minimum, maximum=bound.maximum, time_of_minimum=bound.time_of_minimum,
        time_of_maximum=bound.time_of_maximum, method=bound.method, holds=bool(bound.holds))


def create(**kwargs: Any) -> PowerlinePlannerNode:
    """The node, for its own process or a composed one."""
    return PowerlinePlannerNode(**kwargs)


def main() -> None:
    """Entry point of the executable `powerline_planner`."""
    spin_main(create)
