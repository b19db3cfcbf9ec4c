"""States of the vehicle as published by odometry, estimator and simulator. Stamps are whole nanoseconds, quaternions xyzw."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

Floats = tuple[float, ...]


def rotated(q: Floats, v: Floats, sign: float) -> Floats:
    """`v` rotated by the quaternion `q` (sign +1) or by its inverse (-1), in plain floats: 2 us instead of 35 us in numpy."""
    x, y, z, w = sign * q[0], sign * q[1], sign * q[2], q[3]
    tx, ty, tz = 2 * (y * v[2] - z * v[1]), 2 * (z * v[0] - x * v[2]), 2 * (x * v[1] - y * v[0])
    return (v[0] + w * tx + y * tz - z * ty, v[1] + w * ty + z * tx - x * tz, v[2] + w * tz + x * ty - y * tx)


class OdometryState(NamedTuple):
    """A state with its covariance, as `nav_msgs/Odometry` carries it: the twist is in the child frame.

    Attributes:
        stamp: [ns].
        p_WB: position [m], 3 floats.
        q_WB: attitude, 4 floats.
        v_B: velocity in B [m/s], 3 floats.
        w_B: angular velocity in B [rad/s], 3 floats.
        pose_covariance: of (position in W, rotation about W's axes) [m, rad], shape (6, 6).
        twist_covariance: of (velocity in B, angular velocity in B), shape (6, 6); [0, 0] < 0: no velocity is available.
        frame: W: `map` or `odom`.
    """

    stamp: int
    p_WB: Floats
    q_WB: Floats
    v_B: Floats
    w_B: Floats
    pose_covariance: np.ndarray
    twist_covariance: np.ndarray
    frame: str = "map"

    @property
    def has_twist(self) -> bool:
        """Whether there is a velocity: `twist_covariance`[0, 0] is not negative, nor are velocity and covariance all zero."""
        twist = np.asarray(self.twist_covariance, dtype=float)
        return bool(twist[0, 0] >= 0.0 and (np.any(self.v_B) or twist.any()))

    @property
    def v_WB(self) -> Floats:
        """Velocity in W [m/s], 3 floats."""
        return rotated(self.q_WB, self.v_B, 1.0)


class InertialState(NamedTuple):
    """Full inertial state of VIO with its covariance.

    Attributes:
        stamp: middle of the exposure on the IMU's clock [ns].
        p_WB, v_WB: position and velocity in W [m, m/s], shape (3,).
        q_WB: attitude, shape (4,).
        gyro_bias, accel_bias: [rad/s], [m/s^2], shape (3,).
        covariance: of (p, v, theta, b_g, b_a), theta a rotation vector in B, shape (15, 15).
        frame: W: `odom`.
    """

    stamp: int
    p_WB: np.ndarray
    q_WB: np.ndarray
    v_WB: np.ndarray
    gyro_bias: np.ndarray
    accel_bias: np.ndarray
    covariance: np.ndarray
    frame: str = "odom"


class EstimatorHealth(NamedTuple):
    """Health of the estimator; fields as in perch_msgs/EstimatorStatus.

    Attributes:
        stamp: [ns].
        state: 0 initialising, 1 running, 2 coasting, 3 diverged.
        vio_age: time since the stamp of the last applied measurement [s]; inf before the first.
        accepted, rejected: numbers of measurements so far.
        nis: normalised innovation squared of the last measurement that reached the gate.
        gyro_bias, accel_bias: 3 floats each [rad/s], [m/s^2].
        position_sigma, attitude_sigma: largest 1 sigma [m], [rad]; inf while unknown.
        message: the last event, for people.
    """

    stamp: int
    state: int
    vio_age: float
    accepted: int
    rejected: int
    nis: float
    gyro_bias: Floats
    accel_bias: Floats
    position_sigma: float
    attitude_sigma: float
    message: str


class RotorState(NamedTuple):
    """Rotor speeds [rad/s] and thrusts [N], 4 floats each, at a stamp [ns]."""

    stamp: int
    speed: Floats
    thrust: Floats


class Contact(NamedTuple):
    """Change of the vehicle's contact state; fields as in perch_msgs/Contact."""

    stamp: int
    state: int
    body: str
    normal_speed: float      # into the surface [m/s]
    tangential_speed: float  # [m/s]
    tilt_error: float        # between b3 and s3 [rad]
    offset: float            # from the pad's centre, in the surface [m]
    reason: str


class PoseStamped(NamedTuple):
    """A pose in W at a stamp [ns]: position [m], 3 floats, attitude xyzw, 4 floats."""

    stamp: int
    p: Floats
    q: Floats
