"""Conversions of common parts of messages: stamps, vectors, poses."""

from __future__ import annotations

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, Pose, Quaternion, Vector3
from std_msgs.msg import Header

from perch_core.arrays import Numbers
from perch_core.errors import PerchError
from perch_core.values import NANOSECONDS


def to_stamp(stamp: int) -> Time:
    """Message of a stamp [ns]."""
    return Time(sec=int(stamp // NANOSECONDS), nanosec=int(stamp % NANOSECONDS))


def stamp_value(stamp: Time) -> int:
    """Stamp in whole nanoseconds."""
    return int(stamp.sec * NANOSECONDS + stamp.nanosec)


def header(stamp: int, frame: str) -> Header:
    """Header with a stamp [ns]."""
    return Header(stamp=to_stamp(stamp), frame_id=frame)


def require_measured(gyro: float, accelerometer: float) -> None:
    """Check the first entries of the covariances of an `Imu`: -1 means that there is no such measurement.

    Raises:
        PerchError: a measurement is missing.
    """
    if gyro < 0.0 or accelerometer < 0.0:
        missing = "angular velocity" if gyro < 0.0 else "acceleration"
        raise PerchError(f"imu: no {missing} (covariance -1): both must be in one message")


def floats(v: Vector3 | Point) -> tuple[float, float, float]:
    """Vector or point as 3 floats."""
    return (v.x, v.y, v.z)


def quaternion_floats(q: Quaternion) -> tuple[float, float, float, float]:
    """Quaternion as 4 floats, xyzw."""
    return (q.x, q.y, q.z, q.w)


def to_vector(v: Numbers) -> Vector3:
    """3 numbers as a vector."""
    return Vector3(x=float(v[0]), y=float(v[1]), z=float(v[2]))


def to_point(p: Numbers) -> Point:
    """3 numbers as a point."""
    return Point(x=float(p[0]), y=float(p[1]), z=float(p[2]))


def to_quaternion(q: Numbers) -> Quaternion:
    """4 numbers, xyzw, as a quaternion."""
    return Quaternion(x=float(q[0]), y=float(q[1]), z=float(q[2]), w=float(q[3]))


def to_pose(p: Numbers, q: Numbers) -> Pose:
    """Position and quaternion xyzw as a pose."""
    return Pose(position=to_point(p), orientation=to_quaternion(q))


def flat(matrix: np.ndarray) -> np.ndarray:
    """Return a matrix row by row, float64, as in messages."""
    return np.ascontiguousarray(matrix, dtype=float).ravel()


def square(values: Numbers, n: int) -> np.ndarray:
    """Return `n` * `n` numbers, row by row, as a matrix."""
    return np.array(values, dtype=float).reshape(n, n)
