"""Result of visual-inertial odometry for each frame."""

from __future__ import annotations

import enum
from dataclasses import dataclass

import numpy as np

from perch_perception.ukf.odometry import covariances


class FrameOutcome(enum.Enum):
    """Outcome of a frame."""

    INITIALISING = "waiting for a start at rest or in motion"
    RESTING = "standing still"
    LEAVING = "take-off: IMU only until the first visual update"
    TRACKING = "tracked"
    BLIND = "IMU only: too few usable features in the image"
    LOST = "lost: starting again in motion"
    NOT_NEWER = "refused: stamp is not newer than the frame before"
    FUTURE = "refused: stamp lies ahead of the IMU"
    TOO_OLD = "refused: older than the IMU history"
    REPEATED = "refused: in motion, but the same image as the last: the camera has frozen"
    NO_IMU = "refused: no IMU data yet"
    BAD_IMAGE = "refused: not a grey image of the camera's size"

    @property
    def has_pose(self) -> bool:
        """Whether the frame has a pose."""
        return self in (FrameOutcome.RESTING, FrameOutcome.LEAVING, FrameOutcome.TRACKING)


@dataclass(frozen=True)
class VioPoseEstimate:
    """The body's state at the middle of a frame's exposure.

    Attributes:
        stamp: on the IMU's clock, the estimated time offset applied [ns].
        p_WB, v_WB: [m], [m/s], shape (3,).
        R_WB: shape (3, 3).
        w_WB_B: bias removed [rad/s], shape (3,).
        gyro_bias, accel_bias: [rad/s], [m/s^2], shape (3,).
        P: covariance of (p, v, theta, b_g, b_a), theta a rotation vector in B, shape (15, 15).
    """

    stamp: int
    p_WB: np.ndarray
    R_WB: np.ndarray
    v_WB: np.ndarray
    w_WB_B: np.ndarray
    gyro_bias: np.ndarray
    accel_bias: np.ndarray
    P: np.ndarray

    @property
    def pose_covariance(self) -> np.ndarray:
        """Covariance of (position, rotation about W's axes), shape (6, 6)."""
        return covariances(self.R_WB, self.v_WB, self.P)[0]

    @property
    def velocity_covariance(self) -> np.ndarray:
        """Covariance of the velocity in B, shape (3, 3)."""
        return covariances(self.R_WB, self.v_WB, self.P)[1][:3, :3]


@dataclass(frozen=True)
class VioResult:
    """One frame's result.

    Attributes:
        outcome: see `FrameOutcome`.
        estimate: None where the outcome has no pose.
        features: tracked features; used, refused: observations that changed the state, and those that were refused.
        nis, nis_dimension: normalised innovation squared of all used observations together, and its dimension.
        blind_for: time since the last visual or rest update [s].
        restarts: number of times that the filter was lost.
        message: human-readable outcome.
    """

    outcome: FrameOutcome
    estimate: VioPoseEstimate | None = None
    features: int = 0
    used: int = 0
    refused: int = 0
    nis: float = 0.0
    nis_dimension: int = 0
    blind_for: float = 0.0
    restarts: int = 0
    message: str = ""
