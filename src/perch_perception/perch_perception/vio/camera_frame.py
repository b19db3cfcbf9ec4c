"""Landmark errors in the camera frame: direction and log distance, which stay constant when an update moves the state.

This applies robocentric landmarks (Bloesch et al. 2017) to points that are kept in W. An observation is linear in the direction,
and its information on the camera's rotation relative to the body does not depend on the distance. With errors in W both would be
products of estimates, and each update would add information on a rotation or a distance that no image contains.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from perch_core import so3

_MAX_LOG_STEP = 1.0  # change of a log distance by one step


@dataclass(frozen=True)
class CameraPoints:
    """m points in C.

    Attributes:
        X_C: shape (m, 3).
        by_camera: derivative of X_C with respect to theta, p, camera rotation and camera position, shape (m, 3, 12).
        R_CW: derivative with respect to the point in W, shape (3, 3).
    """

    X_C: np.ndarray
    by_camera: np.ndarray
    R_CW: np.ndarray


def transform_to_camera(R_WB: np.ndarray, p_WB: np.ndarray, R_BC: np.ndarray, p_BC: np.ndarray, X_W: np.ndarray) -> CameraPoints:
    """Transform points in W, shape (m, 3), into C, with derivatives, given the poses of the body and of the camera on it."""
    X_B = (X_W - p_WB) @ R_WB
    X_C = (X_B - p_BC) @ R_BC
    by_camera = np.empty((len(X_W), 3, 12))
    by_camera[:, :, :3], by_camera[:, :, 3:6] = R_BC.T @ so3.hat(X_B), -(R_WB @ R_BC).T
    by_camera[:, :, 6:9], by_camera[:, :, 9:] = so3.hat(X_C), -R_BC.T
    return CameraPoints(X_C, by_camera, (R_WB @ R_BC).T)


def moved(X_C: np.ndarray, step: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Move points by a small step dX_C, applied in direction and log distance.

    Args:
        X_C, step: shape (m, 3).

    Returns:
        X_C', shape (m, 3), and the rotation and scaling S of an error that is constant in direction and log distance,
        dX_C' = S dX_C, shape (m, 3, 3).
    """
    d2 = (X_C**2).sum(axis=1, keepdims=True)
    along = (X_C * step).sum(axis=1, keepdims=True) / d2
    S = np.exp(np.clip(along, -_MAX_LOG_STEP, _MAX_LOG_STEP))[:, :, None] * so3.exp(so3.cross(X_C, step) / d2)
    return (S @ X_C[:, :, None])[:, :, 0], S


def error_transport(before: CameraPoints, after: CameraPoints, S: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the transform of errors in W that keeps those of m points in C constant, except for S, when camera and points move.

        dX_W' = by_camera dc - by_moved dc' + by_point dX_W,

    where dc, dc' are the camera's errors before and after.

    Returns:
        by_camera and by_moved, shape (3m, 12), by_point, shape (m, 3, 3).
    """
    to_W = after.R_CW.T @ S
    return (to_W @ before.by_camera).reshape(-1, 12), (after.R_CW.T @ after.by_camera).reshape(-1, 12), to_W @ before.R_CW
