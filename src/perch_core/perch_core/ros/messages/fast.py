"""Serialisation of the frequent topics, without rclpy's objects: in a tenth of the time."""

from __future__ import annotations

from struct import Struct

import numpy as np
from nav_msgs.msg import Odometry
from perch_core.errors import PerchError
from perch_core.ros.cdr import Layout
from perch_core.ros.messages.basic import require_measured
from perch_core.values import (
    NANOSECONDS, AttitudeThrust, ImuSample, InertialState, MotorCommand, OdometryState, RatesThrust, RotorState)
from perch_msgs.msg import AttitudeThrust as AttitudeMessage
from perch_msgs.msg import MotorCommand as MotorMessage
from perch_msgs.msg import RatesThrust as RatesMessage
from perch_msgs.msg import RotorState as RotorsMessage
from perch_msgs.msg import VioState
from sensor_msgs.msg import Imu

_IMU, _ODOMETRY, _INERTIAL, _MOTOR, _ROTORS = map(Layout, (Imu, Odometry, VioState, MotorMessage, RotorsMessage))
_RATES, _ATTITUDE = map(Layout, (RatesMessage, AttitudeMessage))
_NO_ORIENTATION = np.r_[0.0, 0.0, 0.0, 1.0, -1.0, np.zeros(8)].tobytes()  # attitude and its covariance, -1: there is none
_NO_COVARIANCE = np.zeros(9).tobytes()
_1, _3, _4, _6, _7, _8 = (Struct(f"<{n}d") for n in (1, 3, 4, 6, 7, 8))


def pack_imu(sample: ImuSample) -> bytes:
    """Return the serialised `sensor_msgs/Imu` of a sample."""
    floats = b"".join((_NO_ORIENTATION, _3.pack(*sample.w_B), _NO_COVARIANCE, _3.pack(*sample.f_B), _NO_COVARIANCE))
    return _IMU.pack(*divmod(sample.stamp, NANOSECONDS), sample.frame, floats)


def unpack_imu(data: bytes) -> ImuSample:
    """Return the sample of a `sensor_msgs/Imu`; PerchError if a measurement is missing."""
    sec, nanosec, frame, x = _IMU.unpack(data)
    require_measured(*_1.unpack_from(x, 16 * 8), *_1.unpack_from(x, 28 * 8))
    return ImuSample(sec * NANOSECONDS + nanosec, _3.unpack_from(x, 13 * 8), _3.unpack_from(x, 25 * 8), frame)


def pack_odometry(s: OdometryState) -> bytes:
    """Return the serialised `nav_msgs/Odometry` of a state."""
    floats = b"".join((_7.pack(*s.p_WB, *s.q_WB), np.asarray(s.pose_covariance, "<f8").tobytes(),
                       _6.pack(*s.v_B, *s.w_B), np.asarray(s.twist_covariance, "<f8").tobytes()))
    return _ODOMETRY.pack(*divmod(s.stamp, NANOSECONDS), s.frame, "base_link", floats)


def unpack_odometry(data: bytes) -> OdometryState:
    """Return the state of a `nav_msgs/Odometry`; PerchError if it is not that of the body."""
    sec, nanosec, frame, child, x = _ODOMETRY.unpack(data)
    if child not in ("base_link", ""):
        raise PerchError(f"odometry: child_frame_id is {child!r}: pose and twist must be those of base_link")
    pose, twist, covariances = _7.unpack_from(x), _6.unpack_from(x, 43 * 8), np.frombuffer(x, "<f8")
    return OdometryState(sec * NANOSECONDS + nanosec, pose[:3], pose[3:], twist[:3], twist[3:],
                         covariances[7:43].reshape(6, 6), covariances[49:85].reshape(6, 6), frame)


def pack_inertial(s: InertialState) -> bytes:
    """Return the serialised `perch_msgs/VioState` of a state."""
    x = np.empty(241, "<f8")
    np.concatenate([s.p_WB, s.q_WB, s.v_WB, s.gyro_bias, s.accel_bias, np.reshape(s.covariance, 225)], out=x)  # refuses other sizes
    return _INERTIAL.pack(*divmod(s.stamp, NANOSECONDS), s.frame, x.tobytes())


def unpack_inertial(data: bytes) -> InertialState:
    """Return the state of a `perch_msgs/VioState`."""
    sec, nanosec, frame, floats = _INERTIAL.unpack(data)
    x = np.frombuffer(floats, "<f8").copy()
    return InertialState(sec * NANOSECONDS + nanosec, x[0:3], x[3:7], x[7:10], x[10:13], x[13:16], x[16:].reshape(15, 15), frame)


def pack_motor(command: MotorCommand) -> bytes:
    """Return the serialised `perch_msgs/MotorCommand` of a command."""
    return _MOTOR.pack(*divmod(command.stamp, NANOSECONDS), "base_link", command.armed, _4.pack(*command.rotor_speed))


def unpack_motor(data: bytes) -> MotorCommand:
    """Return the command of a `perch_msgs/MotorCommand`."""
    sec, nanosec, _, armed, speeds = _MOTOR.unpack(data)
    return MotorCommand(sec * NANOSECONDS + nanosec, armed, _4.unpack(speeds))


def pack_rotors(state: RotorState) -> bytes:
    """Return the serialised `perch_msgs/RotorState` of a state."""
    return _ROTORS.pack(*divmod(state.stamp, NANOSECONDS), "base_link", _8.pack(*state.speed, *state.thrust))


def unpack_rotors(data: bytes) -> RotorState:
    """Return the state of a `perch_msgs/RotorState`."""
    sec, nanosec, _, x = _ROTORS.unpack(data)
    values = _8.unpack(x)
    return RotorState(sec * NANOSECONDS + nanosec, values[:4], values[4:])


def pack_rates(command: RatesThrust) -> bytes:
    """Return the serialised `perch_msgs/RatesThrust` of a command."""
    return _RATES.pack(*divmod(command.stamp, NANOSECONDS), "base_link", command.armed, _4.pack(*command.w_B, command.thrust))


def unpack_rates(data: bytes) -> RatesThrust:
    """Return the command of a `perch_msgs/RatesThrust`."""
    sec, nanosec, _, armed, x = _RATES.unpack(data)
    *w_B, thrust = _4.unpack(x)
    return RatesThrust(sec * NANOSECONDS + nanosec, armed, tuple(w_B), thrust)


def pack_attitude(command: AttitudeThrust) -> bytes:
    """Return the serialised `perch_msgs/AttitudeThrust` of a command."""
    return _ATTITUDE.pack(*divmod(command.stamp, NANOSECONDS), "map", command.armed, _8.pack(*command.q_WB, *command.w_B, command.thrust))


def unpack_attitude(data: bytes) -> AttitudeThrust:
    """Return the command of a `perch_msgs/AttitudeThrust`."""
    sec, nanosec, _, armed, x = _ATTITUDE.unpack(data)
    *attitude, wx, wy, wz, thrust = _8.unpack(x)
    return AttitudeThrust(sec * NANOSECONDS + nanosec, armed, tuple(attitude), (wx, wy, wz), thrust)
