"""Messages of the 500 Hz topics as they are on the wire: fields read from and written into their serialised form.

rclpy builds a Python object for every field of a message. At 500 Hz that costs more than what the nodes do with it:
measured between two processes, an `Odometry` costs its subscriber 380 us of processor time with rclpy's conversion and
150 us as bytes; reading its state from the bytes takes 3 us. So subscriptions of the fast topics are `raw`, and publishers
send bytes; other nodes see ordinary messages.

The layout is that of OMG CDR (XCDR1, little endian), which every ROS 2 middleware uses: 4 bytes of encapsulation, then the
fields in order, each aligned to its size, counted from the end of the encapsulation.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from builtin_interfaces.msg import Time
from nav_msgs.msg import Odometry
from perch_msgs.msg import MotorCommand, Release, Step
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import Imu

from perch_core.ros.conversions import NANOSECONDS, turned

_HEADER = 4                  # bytes of encapsulation
_LITTLE_ENDIAN = b"\0\1\0\0"
_STAMP = struct.Struct("<iI")
_LENGTH = struct.Struct("<I")
_IMU = struct.Struct("<3d72x3d")             # angular velocity, its covariance, linear acceleration
_STATE = struct.Struct("<7d288x6d")          # position and attitude, covariance, twist
_STEP = struct.Struct("<iIQ?3xI")            # stamp, index, lockstep, number of releases
_GYRO, _POSE_COVARIANCE, _TWIST_COVARIANCE = 8 * 13, 8 * 7, 8 * 49  # from the first float of the message


def stamp_of(data: bytes) -> int:
    """Nanoseconds of the stamp with which a serialised message begins (its header's, or its own)."""
    sec, nanosec = _STAMP.unpack_from(data, _HEADER)
    return sec * NANOSECONDS + nanosec


def _after_text(data: bytes, offset: int) -> int:
    """Where the text at `offset` ends."""
    offset += -offset % 4
    return offset + 4 + _LENGTH.unpack_from(data, offset)[0]


def _aligned(offset: int) -> int:
    """Where a float64 (or a block that begins with one) may begin at or after `offset`."""
    return offset + (_HEADER - offset) % 8


def _after_header(data: bytes) -> int:
    return _after_text(data, _HEADER + _STAMP.size)


class ImuReading(NamedTuple):
    """What `imu/data_raw` carries: stamp [ns], angular velocity [rad/s] and specific force [m/s^2] in B, (3,) each."""

    stamp: int
    gyro: tuple[float, ...]
    accel: tuple[float, ...]


def read_imu(data: bytes) -> ImuReading:
    """Read a serialised `sensor_msgs/Imu`."""
    values = _IMU.unpack_from(data, _aligned(_after_header(data)) + _GYRO)
    return ImuReading(stamp_of(data), values[:3], values[3:])


class OdometryReading(NamedTuple):
    """State in an odometry message.

    Attributes:
        stamp: [ns].
        p_WB: position [m], (3,).
        q_WB: attitude xyzw, (4,).
        v_WB: velocity in W [m/s], (3,); the message has it in B.
        w_WB_B: angular velocity in B [rad/s], (3,).
    """

    stamp: int
    p_WB: tuple[float, ...]
    q_WB: tuple[float, ...]
    v_WB: tuple[float, ...]
    w_WB_B: tuple[float, ...]


def _odometry_floats(data: bytes) -> int:
    return _aligned(_after_text(data, _after_header(data)))


def read_odometry(data: bytes) -> OdometryReading:
    """Read the state of a serialised `nav_msgs/Odometry`."""
    values = _STATE.unpack_from(data, _odometry_floats(data))
    q = values[3:7]
    return OdometryReading(stamp_of(data), values[:3], q, turned(q, values[7:10], 1.0), values[10:])


def read_pose_covariance(data: bytes) -> np.ndarray:
    """Pose covariance of a serialised `nav_msgs/Odometry`, shape (6, 6)."""
    return np.frombuffer(data, np.float64, 36, _odometry_floats(data) + _POSE_COVARIANCE).reshape(6, 6)


class CommandReading(NamedTuple):
    """What `motor_command` carries: stamp [ns], whether armed, rotor speeds [rad/s], (4,)."""

    stamp: int
    armed: bool
    rotor_speed: tuple[float, ...]


def read_motor_command(data: bytes) -> CommandReading:
    """Read a serialised `perch_msgs/MotorCommand`."""
    offset = _after_header(data)
    return CommandReading(stamp_of(data), data[offset] != 0, struct.unpack_from("<4d", data, _aligned(offset + 1)))


class StepReading(NamedTuple):
    """What `step` and `tick` carry: stamp [ns], index, lockstep or real time, released results (topic, count)."""

    stamp: int
    index: int
    lockstep: bool
    released: tuple[tuple[str, int], ...] = ()


def read_step(data: bytes) -> StepReading:
    """Read a serialised `perch_msgs/Step`."""
    sec, nanosec, index, lockstep, releases = _STEP.unpack_from(data, _HEADER)
    released = ()
    if releases:
        released = tuple((r.topic, r.count) for r in deserialize_message(data, Step).released)
    return StepReading(sec * NANOSECONDS + nanosec, index, lockstep, released)


def write_step(step: StepReading) -> bytes:
    """Serialised `perch_msgs/Step`."""
    sec, nanosec = divmod(step.stamp, NANOSECONDS)
    if step.released:
        return serialize_message(Step(
            stamp=Time(sec=sec, nanosec=nanosec), index=step.index, lockstep=step.lockstep,
            released=[Release(topic=topic, count=count) for topic, count in step.released]))
    return _LITTLE_ENDIAN + _STEP.pack(sec, nanosec, step.index, step.lockstep, 0)


class _Template:
    """A serialised message whose floats change from one to the next, but not its texts."""

    def __init__(self, msg: Any) -> None:
        self._data = bytearray(serialize_message(msg))

    def _stamp(self, stamp: int) -> None:
        _STAMP.pack_into(self._data, _HEADER, stamp // NANOSECONDS, stamp % NANOSECONDS)


class CameraInfoTemplate(_Template):
    """Serialised `sensor_msgs/CameraInfo`; all but the stamp are those of the message given."""

    def fill(self, stamp: int) -> bytes:
        """The message with a stamp [ns]."""
        self._stamp(stamp)
        return bytes(self._data)


class ImuTemplate(_Template):
    """Serialised `sensor_msgs/Imu`; texts and covariances are those of the message given."""

    def __init__(self, msg: Imu) -> None:
        super().__init__(msg)
        floats = _aligned(_after_header(self._data))
        self._gyro, self._accel = floats + _GYRO, floats + _GYRO + 8 * 12

    def fill(self, stamp: int, gyro: Sequence[float], accel: Sequence[float]) -> bytes:
        """The message with a stamp [ns], angular velocity [rad/s] and specific force [m/s^2] in B, (3,) each."""
        self._stamp(stamp)
        struct.pack_into("<3d", self._data, self._gyro, *gyro)
        struct.pack_into("<3d", self._data, self._accel, *accel)
        return bytes(self._data)


class OdometryTemplate(_Template):
    """Serialised `nav_msgs/Odometry`; frames and covariances are those of the message given."""

    def __init__(self, msg: Odometry) -> None:
        super().__init__(msg)
        self._floats = _odometry_floats(self._data)

    def covariances(self, pose: np.ndarray, twist: np.ndarray) -> None:
        """Set both covariances, (6, 6) each, for this message and those that follow."""
        for offset, matrix in ((_POSE_COVARIANCE, pose), (_TWIST_COVARIANCE, twist)):
            begin = self._floats + offset
            self._data[begin:begin + 288] = np.ascontiguousarray(matrix, dtype="<f8").tobytes()

    def fill(self, stamp: int, p_WB: Sequence[float], q_WB: Sequence[float], v_WB: Sequence[float],
             w_WB_B: Sequence[float]) -> bytes:
        """The message with a stamp [ns] and a state: `p_WB` (3,), `q_WB` xyzw (4,), `v_WB` in W (3,), `w_WB_B` (3,)."""
        self._stamp(stamp)
        struct.pack_into("<7d", self._data, self._floats, *p_WB, *q_WB)
        struct.pack_into("<6d", self._data, self._floats + _TWIST_COVARIANCE - 48, *turned(q_WB, v_WB, -1.0), *w_WB_B)
        return bytes(self._data)


class MotorCommandTemplate(_Template):
    """Serialised `perch_msgs/MotorCommand`; the frame is that of the message given."""

    def __init__(self, msg: MotorCommand) -> None:
        super().__init__(msg)
        self._armed = _after_header(self._data)
        self._speeds = _aligned(self._armed + 1)

    def fill(self, stamp: int, armed: bool, rotor_speed: Sequence[float]) -> bytes:
        """The message with a stamp [ns], whether armed, and rotor speeds [rad/s], (4,)."""
        self._stamp(stamp)
        self._data[self._armed] = armed
        struct.pack_into("<4d", self._data, self._speeds, *rotor_speed)
        return bytes(self._data)
