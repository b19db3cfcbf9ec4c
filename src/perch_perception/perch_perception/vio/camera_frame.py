"""Points as a camera sees them: direction and log distance, whose errors stay in place when the state moves.

Robocentric landmarks (Bloesch et al. 2017), for points that are kept in W. An observation is linear in the direction, and what it tells
of the camera's rotation on the body does not depend on the distance. In W both would be products of estimates, and each step of these
would make up a rotation, or a distance, that no image has shown.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from perch_core import so3

_MOST = 1.0  # change of a log distance by one step


@dataclass(frozen=True)
class Seen:
    """m points in C.

    Attributes:
        X_C: shape (m, 3).
        by_camera: derivative of X_C by theta, p, and the camera's rotation and position on the body, shape (m, 3, 12).
        R_CW: derivative by the point in W, shape (3, 3).
    """

    X_C: np.ndarray
    by_camera: np.ndarray
    R_CW: np.ndarray


def see(R_WB: np.ndarray, p_WB: np.ndarray, R_BC: np.ndarray, p_BC: np.ndarray, X_W: np.ndarray) -> Seen:
    """Points in W, shape (m, 3), from a pose of the body by a camera on it."""
    X_B = (X_W - p_WB) @ R_WB
    X_C = (X_B - p_BC) @ R_BC
    by_camera = np.empty((len(X_W), 3, 12))
    by_camera[:, :, :3], by_camera[:, :, 3:6] = R_BC.T @ so3.hat(X_B), -(R_WB @ R_BC).T
    by_camera[:, :, 6:9], by_camera[:, :, 9:] = so3.hat(X_C), -R_BC.T
    return Seen(X_C, by_camera, (R_WB @ R_BC).T)


def moved(X_C: np.ndarray, step: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points moved by a small step dX_C: direction and log distance by what it says of them.

    Args:
        X_C, step: shape (m, 3).

    Returns:
        X_C', shape (m, 3), and the turn and stretch S of an error that stays the same in direction and log distance,
        dX_C' = S dX_C, shape (m, 3, 3).
    """
    d2 = (X_C**2).sum(axis=1, keepdims=True)
    along = (X_C * step).sum(axis=1, keepdims=True) / d2
    S = np.exp(np.clip(along, -_MOST, _MOST))[:, :, None] * so3.exp(np.cross(X_C, step) / d2)
    return (S @ X_C[:, :, None])[:, :, 0], S


def carried(before: Seen, after: Seen, S: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What keeps the errors of m points in C in place, but for S, when camera and points have moved.

        dX_W' = by_camera dc - by_moved dc' + by_point dX_W,

    with dc, dc' the camera's errors before and after.

    Returns:
        by_camera and by_moved, shape (3m, 12), by_point, shape (m, 3, 3).
    """
    to_W = after.R_CW.T @ S
    return (to_W @ before.by_camera).reshape(-1, 12), (after.R_CW.T @ after.by_camera).reshape(-1, 12), to_W @ before.R_CW
