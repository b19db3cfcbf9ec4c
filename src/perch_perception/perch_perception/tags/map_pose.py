"""Pose of the board in the map W, with its uncertainty relative to the vehicle.

The odometry's error at the exposure moves vehicle and board alike. A perch depends on T_BS = T_WB^-1 T_WS alone, so this error is
not included, although it grows during the flight. The odometry's drift after the exposure counts: `perch_core.covariance.drift`.

Two kinds of errors remain: the corners' noise is independent in every image; calibration and time offset are common to all
images, and averaging does not remove them. They are kept apart: `noise` is a covariance, `by_shared` the derivative of the result
by the shared errors c.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from perch_core import so3
from perch_core.camera_mount import CameraMount
from perch_core.sensors import CalibrationSigmas
from perch_perception.pose_buffer import BodyState
from perch_perception.tags.pose import BoardPose

# The shared errors c, in this order
ROTATION, TRANSLATION, INTRINSICS, TIME = slice(0, 3), slice(3, 6), slice(6, 10), 10
SHARED = 11


@dataclass(frozen=True)
class MapPose:
    """Pose of S in the map W from one image.

    Attributes:
        p_WS: position [m], shape (3,).
        R_WS: attitude, shape (3, 3).
        noise: covariance of (dp, dtheta) of T_BS, in the axes of W, from this image alone [m, rad], shape (6, 6).
        by_shared: derivative of (dp, dtheta) by the shared errors c, shape (6, 11).
        shared: covariance of c, shape (11, 11).
        p_BS_W: from the vehicle to S, in W [m], shape (3,).
        odometry: covariance of the vehicle's pose at the exposure, shape (6, 6); with that of a later one it gives the drift.
    """

    p_WS: np.ndarray
    R_WS: np.ndarray
    noise: np.ndarray
    by_shared: np.ndarray
    shared: np.ndarray
    p_BS_W: np.ndarray
    odometry: np.ndarray

    @property
    def covariance(self) -> np.ndarray:
        """Covariance of (dp, dtheta), relative to the vehicle: noise + G cov(c) G^T, shape (6, 6)."""
        return self.noise + self.by_shared @ self.shared @ self.by_shared.T


def to_map(board: BoardPose, body: BodyState, mount: CameraMount, calibration: CalibrationSigmas) -> MapPose:
    """Return T_WS = T_WB T_BC T_CS with the errors of T_BS, to first order.

    Args:
        board: pose in the camera.
        body: state of the body in the middle of the exposure.
        mount: the camera as calibrated.
        calibration: uncertainty of the camera's extrinsics, lens and time offset.
    """
    R_WB = body.R_WB
    R_WC = R_WB @ mount.R_BC
    v_CS_W = R_WC @ board.p_CS                       # from the camera to S, in W
    p_BS_W = R_WB @ mount.p_BC + v_CS_W              # from the body to S, in W
    turned = np.kron(np.eye(2), R_WC)
    by_shared = np.zeros((6, SHARED))
    # the camera turned on the vehicle by a rotation in axes of B, where it is constant
    by_shared[:, ROTATION] = np.concatenate([-so3.hat(v_CS_W), np.eye(3)]) @ R_WB
    by_shared[:3, TRANSLATION] = R_WB
    by_shared[:, INTRINSICS] = turned @ board.by_intrinsics
    w_W = R_WB @ body.w_WB_B
    by_shared[:, TIME] = np.concatenate([body.v_WB + so3.cross(w_W, p_BS_W), w_W])
    sigma = [*[calibration.rotation] * 3, *[calibration.translation] * 3, *calibration.lens, calibration.time_offset]
    return MapPose(body.p_WB + p_BS_W, R_WC @ board.R_CS, turned @ board.covariance @ turned.T, by_shared, np.diag(np.square(sigma)),
                   p_BS_W, body.covariance)
