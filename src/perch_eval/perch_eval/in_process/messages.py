"""A trace as the messages that the real nodes would have published."""

from __future__ import annotations

from typing import Any, Iterator

import numpy as np
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from perch_msgs.msg import (
    Contact, ControllerCommand, ControlReference, EstimatorStatus, MotorCommand, RotorState, Trajectory)

from perch_core import so3
from perch_core.ros.conversions import fill_odometry, to_pose, to_stamp, to_vector
from perch_core.ros.trajectories import flat_message, sampled_message
from perch_core.trajectory import FlatTrajectory
from perch_eval.in_process.stamps import stamp_of
from perch_eval.in_process.trace import ESTIMATE, TRUTH, FlightTrace


def _odometry(stamp: int, row: np.ndarray, frame: str, covariance: np.ndarray | None = None) -> Odometry:
    msg = Odometry(child_frame_id="base_link")
    msg.header.stamp, msg.header.frame_id = to_stamp(stamp), frame
    fill_odometry(msg, row[0:3], row[3:7], row[7:10], row[10:13])
    if covariance is not None:
        msg.pose.covariance = np.ascontiguousarray(covariance, dtype=float).ravel()
    return msg


def _stamped(msg: Any, time: float) -> Any:
    msg.header.stamp, msg.header.frame_id = to_stamp(float(time)), "map"
    return msg


def events(trace: FlightTrace) -> Iterator[tuple[str, int, Any]]:
    """(topic, time [ns], message) of everything that is not published at every step."""
    pad = PoseStamped(pose=to_pose(trace.pad.p_WS, so3.quat_from_matrix(trace.pad.R_WS)))
    yield "ground_truth/target", trace.stamps[0], _stamped(pad, trace.stamps[0] * 1e-9)
    for event in trace.contacts:
        yield "contact", stamp_of(event.time), _stamped(Contact(
            state=int(event.state), body=event.body, normal_speed=float(event.normal_speed),
            tangential_speed=float(event.tangential_speed), tilt_error=float(event.tilt_error), offset=float(event.offset),
            reason=event.reason), event.time)
    for time, flown in trace.trajectories:
        flat = isinstance(flown.trajectory, FlatTrajectory)
        msg: Trajectory = flat_message(flown.trajectory) if flat else sampled_message(flown.trajectory)
        msg.id, msg.at_end, msg.contact_time = flown.id, int(flown.at_end), float(flown.contact_time)
        msg.recovery_start = float(flown.recovery_start)
        yield "recovery" if flown.ready else "trajectory", stamp_of(time), msg
    for time, code, reason in trace.commands:
        yield "controller/command", stamp_of(time), _stamped(ControllerCommand(command=code, reason=reason), time)
    for time, lines in trace.maps:
        yield "powerlines", stamp_of(time), lines
    for time, target in trace.targets:
        msg = PoseWithCovarianceStamped()
        msg.pose.pose = to_pose(target.p_WS, target.q_WS)
        msg.pose.covariance = np.diag([target.position_sigma**2] * 3 + [target.attitude_sigma**2] * 3).ravel()
        yield "target/pose", stamp_of(target.time), _stamped(msg, target.time)


def streams(trace: FlightTrace) -> Iterator[tuple[str, int, Any]]:
    """(topic, time [ns], message) of everything that is published at every step or every few steps."""
    truth, estimate = trace.part(TRUTH), trace.part(ESTIMATE)
    covariances = {stamp_of(t): c for t, c in trace.covariances}
    covariance = np.zeros((6, 6))
    for k, stamp in enumerate(trace.stamps):
        covariance = covariances.get(stamp, covariance)
        yield "ground_truth/odometry", stamp, _odometry(stamp, truth[k], "map")
        yield "odometry", stamp, _odometry(stamp, estimate[k], "map", covariance)
        command = MotorCommand(armed=bool(trace.motors[k][0]))
        command.header.stamp, command.rotor_speed = to_stamp(stamp), np.array(trace.motors[k][1:])
        yield "motor_command", stamp, command
    for row in trace.references:
        msg = ControlReference(pose=to_pose(np.array(row[1:4]), np.array(row[4:8])), linear_velocity=to_vector(row[8:11]),
                               angular_velocity=to_vector(row[11:14]), thrust=float(row[14]))
        yield "controller/reference", stamp_of(row[0]), _stamped(msg, row[0])
    for row in trace.rotors:
        msg = RotorState()
        msg.header.stamp = to_stamp(float(row[0]))
        msg.rotor_speed, msg.thrust = np.array(row[1:5]), np.array(row[5:9])
        yield "rotor_state", stamp_of(row[0]), msg
    for _, pose in trace.vio:
        row = np.concatenate([pose.p_WB, pose.q_WB, np.zeros(3) if pose.v_WB is None else pose.v_WB, np.zeros(3)])
        yield "vio/odometry", pose.stamp, _odometry(pose.stamp, row, "odom", pose.covariance)
    for time, status in trace.estimator:
        yield "estimator/status", stamp_of(time), _stamped(EstimatorStatus(
            state=status.health.value, vio_age=float(status.vio_age), updates_accepted=status.accepted,
            updates_rejected=status.rejected, nis=float(status.nis), position_sigma=float(status.position_sigma),
            attitude_sigma=float(status.attitude_sigma), message=status.message), time)
