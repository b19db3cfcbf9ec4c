"""Pose of the vehicle while there is no filter: the one known last, turned by the gyro since."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from perch_core import so3
from perch_core.covariance import largest_sigma
from perch_perception.ukf.imu_buffer import ImuBuffer
from perch_perception.vio import start
from perch_perception.vio import state as at
from perch_perception.vio.preintegration import preintegrate
from perch_perception.vio.start import KnownPose

_ANYWHERE = 1000.0  # 1 sigma of a position of which nothing is known; none is larger: receivers refuse more than 10 km [m]


class LastPose:
    """The pose known last, and the rotation since.

    Attributes:
        pose: the pose as known then.
        known_at: stamp of the pose in motion, and the speed then [ns, m/s]; None: the vehicle has not moved since.
    """

    def __init__(self, pose: KnownPose) -> None:
        self.pose = pose
        self.known_at: tuple[int, float] | None = None
        self.begin_rotation(np.zeros(3))

    def begin_rotation(self, gyro_bias: np.ndarray) -> None:
        """Begin to sum the rotation, by the gyro less a bias [rad/s], shape (3,)."""
        # the rotation, the derivative of its rotation vector by the bias, and its covariance from noise
        self._rotation, self._gyro_bias = (np.eye(3), np.zeros((3, 3)), np.zeros((3, 3))), gyro_bias

    def rotate(self, steps: np.ndarray) -> None:
        """Add the rotation of IMU steps (m, 9)."""
        part = preintegrate(steps, self._gyro_bias, np.zeros(3))
        R, J, P = self._rotation
        self._rotation = R @ part.dR, part.dR.T @ J + part.J[:3, :3], part.dR.T @ P @ part.dR + part.Q[:3, :3]

    def present(self, gyro_bias: np.ndarray | None = None) -> KnownPose:
        """Return the present pose, with the heading propagated by the gyro less this bias; None: the one of the sum."""
        dR, J, P = self._rotation
        change = np.zeros(3) if gyro_bias is None else gyro_bias - self._gyro_bias
        return self.pose.turned(self.pose.R_WB @ dR @ so3.exp(J @ change), J, P)

    def forget(self) -> None:
        """Make all positions and headings alike."""
        self.pose = replace(self.pose, covariance=_ANYWHERE**2 * np.eye(4))
        self.forget_heading()

    def forget_heading(self) -> None:
        """Make all headings alike."""
        covariance = self.pose.covariance.copy()
        covariance[3, :3] = covariance[:3, 3] = 0.0
        covariance[3, 3] = np.pi**2 / 3.0
        self.pose = replace(self.pose, covariance=covariance)

    def propagate_position(self, state: at.State, imu: ImuBuffer) -> None:
        """Propagate the position of a start in motion from where it was known, with a 1 sigma of at most `_ANYWHERE`."""
        if self.known_at is None:
            return
        since, speed = self.known_at
        if since >= imu.oldest:
            start.propagate_position(state, preintegrate(imu.run(since, state.stamp), state.gyro_bias, state.accel_bias))
        else:  # its motion since then is unknown
            reach = 1e-9 * (state.stamp - since) * max(speed, float(np.linalg.norm(state.v_WB)))
            state.P[at.POSITION, at.POSITION] += reach**2 * np.eye(3)
        if (excess := largest_sigma(state.P[at.POSITION, at.POSITION]) / _ANYWHERE) > 1.0:
            state.P[at.POSITION] /= excess
            state.P[:, at.POSITION] /= excess
        self.known_at = None
