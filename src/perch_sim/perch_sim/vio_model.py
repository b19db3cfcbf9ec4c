"""A stand-in for visual-inertial odometry: the truth with drift and noise. It is NOT an estimator.

It serves to run the rest of the stack without images; flights that are evaluated use `perch_perception vio`.

Error model, per pose: position and yaw drift as random walks; roll and pitch do not drift, as gravity makes them observable.
White noise is added to position, attitude and velocity. A filter's pose is smooth: from frame to frame it jumps by a
millimetre or two, while its drift grows to a centimetre within a flight. The covariance of a pose is that of the white
noise plus that of the drift so far.

A VIO estimates the biases of the IMU, too: each estimate has a constant error of known standard deviation, while the true bias
walks away from its value at turn-on.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from perch_core import so3
from perch_core.config import quantity, text
from perch_core.vehicle import ImuConfig

CAMERA = "down"           # whose frames are answered
YAW_DRIFT = 0.001         # random walk [rad/sqrt(s)]
ATTITUDE_NOISE = 0.0015   # 1 sigma of each axis, white [rad]
VELOCITY_NOISE = 0.01     # 1 sigma of each axis, white [m/s]; rendered flights of line_80 (seeds 1 to 4): 0.009 within a second
GYRO_BIAS_ERROR, ACCEL_BIAS_ERROR = 0.0005, 0.015  # of each axis' estimate, 1 sigma [rad/s, m/s^2]


@dataclass(frozen=True, kw_only=True)
class VioModelParameters:
    """Parameters of the node `vio_model`."""

    vehicle: str = text("snapdragon", doc="config/vehicles/<name>.yaml")
    seed: int = quantity(1, low=0, high=2**31 - 1, doc="the vehicle's: the biases of its IMU are known by it")
    latency: float = quantity(0.0, unit="s", low=0.0, high=1.0,
                              doc="exposure to output, by the stamps of the truth; 0 where a schedule lets the output count later")
    position_drift: float = quantity(0.004, unit="m/sqrt(s)", low=0.0, doc="random walk of each axis")
    position_noise: float = quantity(0.0015, unit="m", low=0.0, doc="1 sigma of each axis, white")


class VioEstimate(NamedTuple):
    """A degraded pose and velocity, both in W."""

    p_WB: np.ndarray        # (3,) [m]
    q_WB: np.ndarray        # xyzw, (4,)
    v_WB: np.ndarray        # (3,) [m/s]
    velocity_variance: float    # of each axis [m^2/s^2]
    covariance: np.ndarray      # of (p, v, theta), theta a rotation vector in B, with what the drift of yaw makes correlated, (9, 9)

    @property
    def pose_covariance(self) -> np.ndarray:
        """Covariance of (position, rotation about W's axes), (6, 6)."""
        to_pose = np.zeros((6, 9))
        to_pose[:3, :3], to_pose[3:, 6:] = np.eye(3), so3.quat_to_matrix(self.q_WB)
        return to_pose @ self.covariance @ to_pose.T


class VioModel:
    """Degrades the true poses of one flight in order; owns the drift."""

    def __init__(self, params: VioModelParameters, rng: np.random.Generator) -> None:
        self._params, self._rng = params, rng
        self._drift, self._yaw = np.zeros(3), 0.0
        self._first: float | None = None
        self._last: float | None = None

    def degrade(self, time: float, p_WB: np.ndarray, q_WB: np.ndarray, v_WB: np.ndarray) -> VioEstimate:
        """Return a pose such as a VIO would estimate.

        Args:
            time: time of the pose [s], later than that of the previous call.
            p_WB, q_WB, v_WB: true pose and velocity [m, xyzw, m/s].
        """
        k, draw = self._params, self._rng.standard_normal(13)
        root = 0.0 if self._last is None else math.sqrt(max(0.0, time - self._last))
        self._first = time if self._first is None else self._first
        self._last = time
        self._drift = self._drift + k.position_drift * root * draw[:3]
        self._yaw += YAW_DRIFT * root * draw[3]
        turn = so3.quat_exp(np.array([0.0, 0.0, self._yaw]))
        shake = so3.quat_exp(ATTITUDE_NOISE * draw[4:7])
        age = time - self._first
        p = so3.quat_rotate(turn, p_WB) + self._drift + k.position_noise * draw[7:10]
        q = so3.quat_multiply(turn, so3.quat_multiply(shake, q_WB))
        v = so3.quat_rotate(turn, v_WB) + VELOCITY_NOISE * draw[10:13]
        of_yaw = np.array([-p[1], p[0], 0.0, -v[1], v[0], 0.0, *so3.quat_to_matrix(q)[2]])  # e3 x p, e3 x v, R^T e3
        independent = np.repeat([k.position_noise**2 + k.position_drift**2 * age, VELOCITY_NOISE**2, ATTITUDE_NOISE**2], 3)
        return VioEstimate(p, q, v, VELOCITY_NOISE**2, np.diag(independent) + YAW_DRIFT**2 * age * np.outer(of_yaw, of_yaw))


class BiasModel:
    """Model of the IMU biases that a VIO would estimate."""

    def __init__(self, imu: ImuConfig, turn_on: np.ndarray, rng: np.random.Generator) -> None:
        """
        Args:
            imu: provides the random walk of the true biases.
            turn_on: true biases at the start of the flight, gyro [rad/s] and accelerometer [m/s^2], (6,).
            rng: random stream of the errors.
        """
        sigma = np.repeat([GYRO_BIAS_ERROR, ACCEL_BIAS_ERROR], 3)
        self._estimate = turn_on + sigma * rng.standard_normal(6)
        self._variance, self._walk = sigma**2, np.repeat([imu.gyro_bias_walk, imu.accel_bias_walk], 3) ** 2

    def at(self, age: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the estimates and their variances, (6,) each, at a time [s] after the start."""
        return self._estimate, self._variance + self._walk * age
