"""`perch_msgs/srv/PlanPowerline` to the planner's request, and its plans to the response."""

from __future__ import annotations

import numpy as np
from perch_msgs.msg import Certificate, Powerline, Trajectory
from perch_msgs.srv import PlanPowerline

from perch_core.errors import PlanningRefusal
from perch_core.lines import Segment
from perch_core.ros.conversions import pose_arrays, to_array
from perch_core.ros.trajectories import sampled_message
from perch_core.rotor_model import P, THRUST, V, W, RotorModel, hover_state
from perch_planner.powerline.certificate import Bound
from perch_planner.powerline.plan import PowerlinePlan
from perch_planner.powerline.request import PerchPose, PowerlineRequest


def powerline_request(msg: PlanPowerline.Request, model: RotorModel, wire_offset: float) -> PowerlineRequest:
    """The planner's request of a message.

    Args:
        msg: as asked.
        model: of the vehicle, for the thrusts of a hover.
        wire_offset: from the wire's axis to the centre of mass along b3 [m].

    Raises:
        PerchError: values that cannot be a request.
    """
    p_WB, q_WB = pose_arrays(msg.start_pose)
    norm = float(np.linalg.norm(q_WB))
    if not abs(norm - 1.0) < 1e-2:
        raise PlanningRefusal("bad_input", "start attitude", -1.0, f"start quaternion has norm {norm:.4f}, not 1")
    start = hover_state(model, p_WB, q_WB)
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
        perch = PerchPose.on_line(target, point, float(msg.perch_pitch), wire_offset, start[P], velocity)
    return PowerlineRequest(start, lines, request.target_line, perch, request.perception, request.with_recovery)


def fill_response(response: PlanPowerline.Response, plan: PowerlinePlan, model: RotorModel, sample_step: float,
                  contact_time: float) -> None:
    """Write a plan into a response; the trajectory's stamp is left to the caller.

    Args:
        response: to be filled.
        plan: what was found.
        model: of the vehicle, for the accelerations.
        sample_step: spacing of the trajectory's points [s].
        contact_time: how long the grip is awaited after a perch without recovery [s].
    """
    trajectory = plan.trajectory(model, step=sample_step)
    response.success = True
    response.trajectory = sampled_message(trajectory)
    message = []
    if plan.perch is not None:
        response.perch_time, response.solve_time = float(plan.perch.duration), float(plan.perch.solve_time)
        response.trajectory.at_end = Trajectory.AT_END_CONTACT
        response.trajectory.contact_time = float(contact_time)
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
