"""Conversions of trajectories, commands and the controller's answers."""

from __future__ import annotations

import numpy as np
from perch_core.errors import PerchError
from perch_core.ros.messages.basic import floats, header, quaternion_floats, stamp_value, to_pose, to_vector
from perch_core.trajectory import FlatTrajectory, SampledTrajectory
from perch_core.values import (
    AtEnd, ControllerCommand, ControllerStatus, ControlReference, SetControllerRequest, SetControllerResponse, TrajectoryOrder, TriggerRequest,
    TriggerResponse, nanoseconds, seconds)
from perch_msgs.msg import ControllerCommand as CommandMessage
from perch_msgs.msg import ControllerStatus as StatusMessage
from perch_msgs.msg import ControlReference as ReferenceMessage
from perch_msgs.msg import PolynomialSegment, Trajectory, TrajectoryPoint
from perch_msgs.srv import SetController
from std_srvs.srv import Trigger

FRAME = "map"


# -- trajectories ------------------------------------------------------------------------------------------------------


def trajectory_message(trajectory: FlatTrajectory | SampledTrajectory) -> Trajectory:
    """Convert a trajectory to `perch_msgs/Trajectory`, with `at_end` HOLD."""
    msg = Trajectory(header=header(nanoseconds(trajectory.start_time), FRAME), recovery_start=-1.0)
    if isinstance(trajectory, FlatTrajectory):
        for duration, (x, y, z, yaw) in zip(trajectory.durations, trajectory.coefficients):
            msg.segments.append(PolynomialSegment(duration=float(duration), x=x.tolist(), y=y.tolist(), z=z.tolist(), yaw=yaw.tolist()))
        return msg
    for i, time in enumerate(trajectory.times):
        point = TrajectoryPoint(
            time_from_start=float(time), pose=to_pose(trajectory.p[i], trajectory.q[i]), linear_velocity=to_vector(trajectory.v[i]),
            angular_velocity=to_vector(trajectory.w[i]), linear_acceleration=to_vector(trajectory.a[i]),
            angular_acceleration=to_vector(trajectory.dw[i]))
        point.rotor_thrust = trajectory.rotor_thrust[i].astype(float)
        msg.points.append(point)
    return msg


def trajectory_value(msg: Trajectory) -> FlatTrajectory | SampledTrajectory:
    """Return the trajectory of a message: the samples if it has any, otherwise the polynomials.

    Raises:
        PerchError: empty, of unequal lengths, not finite, or in another frame than `map`.
    """
    if msg.header.frame_id != FRAME:
        raise PerchError(f"trajectory: header.frame_id {msg.header.frame_id!r} is not {FRAME!r}")
    start = seconds(stamp_value(msg.header.stamp))
    try:
        if msg.points:
            return SampledTrajectory(
                times=np.array([p.time_from_start for p in msg.points]), p=np.array([floats(p.pose.position) for p in msg.points]),
                q=np.array([quaternion_floats(p.pose.orientation) for p in msg.points]),
                v=np.array([floats(p.linear_velocity) for p in msg.points]), w=np.array([floats(p.angular_velocity) for p in msg.points]),
                a=np.array([floats(p.linear_acceleration) for p in msg.points]),
                dw=np.array([floats(p.angular_acceleration) for p in msg.points]),
                rotor_thrust=np.array([p.rotor_thrust for p in msg.points]), start_time=start)
        if not msg.segments:
            raise ValueError("it has neither segments nor points")
        rows = [[list(s.x), list(s.y), list(s.z), list(s.yaw)] for s in msg.segments]
        if len({len(row) for segment in rows for row in segment}) != 1:
            raise ValueError("the segments' coefficients are of unequal length")
        return FlatTrajectory(np.array([s.duration for s in msg.segments]), np.array(rows), start)
    except ValueError as error:
        raise PerchError(f"trajectory: {error}") from None


def order_message(order: TrajectoryOrder) -> Trajectory:
    """Convert an order to `perch_msgs/Trajectory`."""
    msg = trajectory_message(order.trajectory)
    msg.id, msg.at_end = int(order.id), int(order.at_end)
    msg.contact_time, msg.recovery_start = float(order.contact_time), float(order.recovery_start)
    return msg


def order_value(msg: Trajectory) -> TrajectoryOrder:
    """Convert `perch_msgs/Trajectory` to an order.

    Raises:
        PerchError: invalid trajectory (see `trajectory_value`), or an unknown `at_end`.
    """
    try:
        at_end = AtEnd(msg.at_end)
    except ValueError:
        raise PerchError(f"trajectory {msg.id}: at_end {msg.at_end} is not one of 0..3") from None
    try:
        return TrajectoryOrder(msg.id, trajectory_value(msg), at_end, msg.contact_time, msg.recovery_start)
    except PerchError as error:
        raise PerchError(f"trajectory {msg.id}: {error}") from None


# -- commands ----------------------------------------------------------------------------------------------------------


def command_message(command: ControllerCommand) -> CommandMessage:
    """Convert to `perch_msgs/ControllerCommand`."""
    return CommandMessage(header=header(command.stamp, FRAME), command=int(command.command), reason=command.reason)


def command_value(msg: CommandMessage) -> ControllerCommand:
    """Convert from `perch_msgs/ControllerCommand`."""
    return ControllerCommand(stamp_value(msg.header.stamp), msg.command, msg.reason)


def status_message(status: ControllerStatus) -> StatusMessage:
    """Convert to `perch_msgs/ControllerStatus`."""
    return StatusMessage(
        header=header(status.stamp, FRAME), state=int(status.state), controller=status.controller, trajectory_id=int(status.trajectory_id),
        trajectory_time=float(status.trajectory_time), trajectory_duration=float(status.trajectory_duration),
        position_error=float(status.position_error), odometry_age=float(status.odometry_age), thrust_margin=float(status.thrust_margin),
        thrust_ratio=float(status.thrust_ratio), message=status.message)


def status_value(msg: StatusMessage) -> ControllerStatus:
    """Convert from `perch_msgs/ControllerStatus`."""
    return ControllerStatus(
        stamp_value(msg.header.stamp), msg.state, msg.controller, msg.trajectory_id, msg.trajectory_time, msg.trajectory_duration,
        msg.position_error, msg.odometry_age, msg.thrust_margin, msg.thrust_ratio, msg.message)


def reference_message(x: ControlReference) -> ReferenceMessage:
    """Convert to `perch_msgs/ControlReference`."""
    return ReferenceMessage(
        header=header(x.stamp, FRAME), trajectory_id=int(x.trajectory_id), pose=to_pose(x.p, x.q), linear_velocity=to_vector(x.v),
        linear_acceleration=to_vector(x.a), angular_velocity=to_vector(x.w), angular_acceleration=to_vector(x.dw), thrust=float(x.thrust),
        moment=to_vector(x.moment))


def reference_value(msg: ReferenceMessage) -> ControlReference:
    """Convert from `perch_msgs/ControlReference`."""
    return ControlReference(
        stamp_value(msg.header.stamp), msg.trajectory_id, floats(msg.pose.position), quaternion_floats(msg.pose.orientation),
        floats(msg.linear_velocity), floats(msg.linear_acceleration), floats(msg.angular_velocity), floats(msg.angular_acceleration),
        msg.thrust, floats(msg.moment))


# -- services ----------------------------------------------------------------------------------------------------------


def set_controller_request_value(msg: SetController.Request) -> SetControllerRequest:
    """Convert a request of `set_controller`."""
    return SetControllerRequest(msg.type, msg.adaptive)


def set_controller_response_message(answer: SetControllerResponse) -> SetController.Response:
    """Convert an answer of `set_controller` to its message."""
    return SetController.Response(success=bool(answer.success), error_code=int(answer.error_code), message=answer.message)


def trigger_request_value(_: Trigger.Request) -> TriggerRequest:
    """Convert a request of a std_srvs/Trigger."""
    return TriggerRequest()


def trigger_response_message(answer: TriggerResponse) -> Trigger.Response:
    """Convert an answer of a std_srvs/Trigger to its message."""
    return Trigger.Response(success=bool(answer.success), message=answer.message)
