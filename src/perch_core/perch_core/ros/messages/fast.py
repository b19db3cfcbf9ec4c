"""The messages of the 500 Hz topics, on the wire: what `sensing`, `states` and `flight` do with rclpy's objects, in a tenth of the time."""

from __future__ import annotations

import numpy as np
from nav_msgs.msg import Odometry
from perch_core.ros.cdr import Layout
from perch_core.values import NANOSECONDS, AttitudeThrust, ImuSample, MotorCommand, OdometryState, RatesThrust
from perch_msgs.msg import AttitudeThrust as AttitudeMessage
from perch_msgs.msg import MotorCommand as MotorMessage
from perch_msgs.msg import RatesThrust as RatesMessage
from sensor_msgs.msg import Imu

_IMU, _ODOMETRY, _MOTOR, _RATES, _ATTITUDE = map(Layout, (Imu, Odometry, MotorMessage, RatesMessage, AttitudeMessage))
_NO_ORIENTATION = np.r_[0.0, 0.0, 0.0, 1.0, -1.0, np.zeros(8)].tobytes()  # attitude and its covariance, which says that there is none
_NO_COVARIANCE = np.zeros(9).tobytes()


def _stamp(stamp: int) -> tuple[tuple[int], tuple[int]]:
    sec, nanosec = divmod(stamp, NANOSECONDS)
    return (sec,), (nanosec,)


def pack_imu(sample: ImuSample) -> bytes:
    """`sensor_msgs/Imu` of a sample."""
    floats = b"".join((_NO_ORIENTATION, np.array(sample.w_B, "<f8").tobytes(), _NO_COVARIANCE, np.array(sample.f_B, "<f8").tobytes(), _NO_COVARIANCE))
    return _IMU.pack(*_stamp(sample.stamp), sample.frame, floats)


def unpack_imu(data: bytes) -> ImuSample:
    """The sample of a `sensor_msgs/Imu`."""
    (sec,), (nanosec,), frame, x = _IMU.unpack(data)
    return ImuSample(sec * NANOSECONDS + nanosec, tuple(x[13:16].tolist()), tuple(x[25:28].tolist()), frame)


def pack_odometry(s: OdometryState) -> bytes:
    """`nav_msgs/Odometry` of a state."""
    floats = b"".join((np.array((*s.p_WB, *s.q_WB), "<f8").tobytes(), np.ascontiguousarray(s.pose_covariance, "<f8").tobytes(),
                       np.array((*s.v_B, *s.w_B), "<f8").tobytes(), np.ascontiguousarray(s.twist_covariance, "<f8").tobytes()))
    return _ODOMETRY.pack(*_stamp(s.stamp), s.frame, "base_link", floats)


def unpack_odometry(data: bytes) -> OdometryState:
    """The state of a `nav_msgs/Odometry`."""
    (sec,), (nanosec,), frame, _, x = _ODOMETRY.unpack(data)
    pose, twist = tuple(x[:7].tolist()), tuple(x[43:49].tolist())
    return OdometryState(sec * NANOSECONDS + nanosec, pose[:3], pose[3:], twist[:3], twist[3:], x[7:43].reshape(6, 6), x[49:85].reshape(6, 6), frame)


def pack_motor(command: MotorCommand) -> bytes:
    """`perch_msgs/MotorCommand` of a command."""
    return _MOTOR.pack(*_stamp(command.stamp), "base_link", (command.armed,), tuple(map(float, command.rotor_speed)))


def unpack_motor(data: bytes) -> MotorCommand:
    """The command of a `perch_msgs/MotorCommand`."""
    (sec,), (nanosec,), _, (armed,), speeds = _MOTOR.unpack(data)
    return MotorCommand(sec * NANOSECONDS + nanosec, armed, tuple(speeds.tolist()))


def pack_rates(command: RatesThrust) -> bytes:
    """`perch_msgs/RatesThrust` of a command."""
    return _RATES.pack(*_stamp(command.stamp), "base_link", (command.armed,), (*map(float, command.w_B), float(command.thrust)))


def unpack_rates(data: bytes) -> RatesThrust:
    """The command of a `perch_msgs/RatesThrust`."""
    (sec,), (nanosec,), _, (armed,), x = _RATES.unpack(data)
    return RatesThrust(sec * NANOSECONDS + nanosec, armed, tuple(x[:3].tolist()), float(x[3]))


def pack_attitude(command: AttitudeThrust) -> bytes:
    """`perch_msgs/AttitudeThrust` of a command."""
    floats = tuple(map(float, (*command.q_WB, *command.w_B, command.thrust)))
    return _ATTITUDE.pack(*_stamp(command.stamp), "map", (command.armed,), floats)


def unpack_attitude(data: bytes) -> AttitudeThrust:
    """The command of a `perch_msgs/AttitudeThrust`."""
    (sec,), (nanosec,), _, (armed,), x = _ATTITUDE.unpack(data)
    return AttitudeThrust(sec * NANOSECONDS + nanosec, armed, tuple(x[:4].tolist()), tuple(x[4:7].tolist()), float(x[7]))
