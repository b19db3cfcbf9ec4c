"""Recursive fusion of all images into one target pose in the map, with a consistent covariance.

A Schmidt-Kalman filter: the target's six errors relative to the vehicle are estimated, the shared errors (calibration, time
offset) are only considered, with their correlation to the estimate. Corner noise therefore averages out, shared errors do not,
and near images, which they affect less, have more weight. Between images the odometry's drift is process noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from perch_core import so3
from perch_core.covariance import drift
from perch_perception.tags.map_pose import MapPose

GATE = 22.5        # chi^2 with 6 degrees of freedom, 99.9 %
RESTART_AFTER = 5  # so many images in a row that contradict the estimate replace it


@dataclass(frozen=True)
class FusedTarget:
    """Target estimate from all images so far; `fuse` returns the next one.

    Attributes:
        p_WS: position [m], shape (3,).
        R_WS: attitude, shape (3, 3).
        joint: covariance of (dp, dtheta, c), shape (17, 17), c being the shared errors of `map_pose`.
        odometry: covariance of the vehicle's pose at the last image, shape (6, 6).
        frames: number of images used.
        refused: number of consecutive images that contradicted the estimate.
    """

    p_WS: np.ndarray
    R_WS: np.ndarray
    joint: np.ndarray
    odometry: np.ndarray
    frames: int = 1
    refused: int = 0

    @property
    def covariance(self) -> np.ndarray:
        """Covariance of (dp, dtheta) relative to the vehicle at the last image, in the axes of W, shape (6, 6)."""
        return self.joint[:6, :6]


def start_fusion(pose: MapPose) -> FusedTarget:
    """Return the target after its first image."""
    cross = pose.by_shared @ pose.shared
    return FusedTarget(pose.p_WS, pose.R_WS, np.block([[pose.covariance, cross], [cross.T, pose.shared]]), pose.odometry)


def fuse(target: FusedTarget, pose: MapPose) -> FusedTarget:
    """Return the target after one more image.

    An image that contradicts the estimate (a flip, a wrong tag) is counted but not used. After five in a row the estimate
    is considered wrong (the pad was moved, the odometry jumped) and is replaced.
    """
    joint = target.joint.copy()
    joint[:6, :6] += drift(pose.odometry, target.odometry, pose.p_BS_W)
    innovation = np.concatenate([pose.p_WS - target.p_WS, so3.log(pose.R_WS @ target.R_WS.T)])
    # With e = estimate - truth and measurement = truth + G c + v: innovation = -(e - G c) + v.
    H = np.concatenate([np.eye(6), -pose.by_shared], axis=1)
    S = H @ joint @ H.T + pose.noise
    if innovation @ np.linalg.solve(S, innovation) > GATE:
        if target.refused + 1 >= RESTART_AFTER:
            return start_fusion(pose)
        return FusedTarget(target.p_WS, target.R_WS, joint, pose.odometry, target.frames, target.refused + 1)
    K = np.linalg.solve(S, (joint @ H.T)[:6].T).T             # gain of the target only: Schmidt
    shift = K @ innovation
    update = np.eye(joint.shape[0])
    update[:6] -= K @ H
    joint = update @ joint @ update.T
    joint[:6, :6] += K @ pose.noise @ K.T                     # Joseph form
    return FusedTarget(target.p_WS + shift[:3], so3.exp(shift[3:]) @ target.R_WS, 0.5 * (joint + joint.T), pose.odometry, target.frames + 1)
