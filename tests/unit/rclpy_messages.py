"""The messages of frequent topics as objects of rclpy, field by field: a second source beside `perch_core.ros.messages.fast`."""

from __future__ import annotations

import numpy as np
from nav_msgs.msg import Odometry
from perch_core.ros.messages.basic import flat, header, to_point, to_pose, to_quaternion, to_vector
from perch_core.values import AttitudeThrust, ImuSample, InertialState, MotorCommand, OdometryState, RatesThrust, RotorState
from perch_msgs import msg as perch_msgs
from sensor_msgs.msg import Imu


def message_of(value):
    """The message of a value."""
    return MESSAGES[type(value)](value)


def _imu(sample):
    msg = Imu(header=header(sample.stamp, sample.frame), angular_velocity=to_vector(sample.w_B), linear_acceleration=to_vector(sample.f_B))
    msg.orientation_covariance[0] = -1.0  # sensor_msgs: no orientation
    return msg


def _odometry(state):
    msg = Odometry(header=header(state.stamp, state.frame), child_frame_id="base_link")
    msg.pose.pose = to_pose(state.p_WB, state.q_WB)
    msg.twist.twist.linear, msg.twist.twist.angular = to_vector(state.v_B), to_vector(state.w_B)
    msg.pose.covariance, msg.twist.covariance = flat(state.pose_covariance), flat(state.twist_covariance)
    return msg


def _inertial(state):
    return perch_msgs.VioState(
        header=header(state.stamp, state.frame), position=to_point(state.p_WB), orientation=to_quaternion(state.q_WB),
        velocity=to_vector(state.v_WB), gyro_bias=to_vector(state.gyro_bias), accel_bias=to_vector(state.accel_bias),
        covariance=flat(state.covariance))


def _motor(command):
    return perch_msgs.MotorCommand(header=header(command.stamp, "base_link"), armed=command.armed, rotor_speed=np.array(command.rotor_speed))


def _rates(command):
    return perch_msgs.RatesThrust(header=header(command.stamp, "base_link"), armed=command.armed, body_rates=to_vector(command.w_B),
                                  thrust=command.thrust)


def _attitude(command):
    return perch_msgs.AttitudeThrust(header=header(command.stamp, "map"), armed=command.armed, attitude=to_quaternion(command.q_WB),
                                     body_rates=to_vector(command.w_B), thrust=command.thrust)


def _rotors(state):
    return perch_msgs.RotorState(header=header(state.stamp, "base_link"), rotor_speed=np.array(state.speed), thrust=np.array(state.thrust))


MESSAGES = {ImuSample: _imu, OdometryState: _odometry, InertialState: _inertial, MotorCommand: _motor, RatesThrust: _rates, AttitudeThrust: _attitude,
            RotorState: _rotors}
