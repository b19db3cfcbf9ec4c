"""What a camera says about a point: a unit bearing, its residual against a prediction, and all derivatives.

Bearings, not pixels: on a fisheye a pixel's error is nearly the same angle everywhere, and nothing is singular at
90 deg from the axis. A residual is a pair of tangent coordinates at the measured bearing, [rad].
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from perch_core.camera import Camera, EquidistantCamera


@dataclass(frozen=True)
class Bearings:
    """n measured bearings.

    Attributes:
        b_C: unit vectors in C, shape (n, 3).
        by_focal: their derivative by the logarithm of the focal length, shape (n, 3).
    """

    b_C: np.ndarray
    by_focal: np.ndarray


@dataclass(frozen=True)
class Residuals:
    """Residuals of n observations and their derivatives (rows of H: r = H x + n).

    Attributes:
        r: measured minus predicted, shape (n, 2).
        by_theta, by_position: by the body pose's error, shape (n, 2, 3).
        by_point: by the point's position in W, shape (n, 2, 3).
        by_camera_rotation, by_camera_position: by the extrinsics' errors, shape (n, 2, 3).
        by_focal: by the relative focal error, shape (n, 2).
        cosine: between measured and predicted bearing, shape (n,).
        distance: from the camera to the point [m], shape (n,).
    """

    r: np.ndarray
    by_theta: np.ndarray
    by_position: np.ndarray
    by_point: np.ndarray
    by_camera_rotation: np.ndarray
    by_camera_position: np.ndarray
    by_focal: np.ndarray
    cosine: np.ndarray
    distance: np.ndarray


def observe(camera: Camera, pixels: np.ndarray) -> Bearings:
    """Bearings of pixels, shape (n, 2)."""
    b = camera.unproject(pixels)
    rho = np.linalg.norm(b[:, :2], axis=1)
    safe = np.where(rho > 1e-9, rho, 1.0)
    e = np.where((rho > 1e-9)[:, None], b[:, :2] / safe[:, None], 0.0)
    outward = np.column_stack([b[:, 2:] * e, -rho])  # unit tangent away from the axis
    if isinstance(camera, EquidistantCamera):
        theta = np.arctan2(rho, b[:, 2])
        angle = -camera.radius(theta) / camera.radius_slope(theta)
    else:
        angle = -rho * b[:, 2]  # theta = atan(r), r shrinks as f grows
    return Bearings(b, outward * angle[:, None])


def corrected(measured: Bearings, focal: float) -> np.ndarray:
    """Unit bearings for a relative focal error, shape (n, 3)."""
    b = measured.b_C + focal * measured.by_focal
    return b / np.linalg.norm(b, axis=1, keepdims=True)


def skew(v: np.ndarray) -> np.ndarray:
    """`so3.hat` for many vectors without its checks: (n, 3) -> (n, 3, 3)."""
    out = np.zeros((len(v), 3, 3))
    out[:, 0, 1], out[:, 0, 2], out[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    out[:, 1, 0], out[:, 2, 0], out[:, 2, 1] = v[:, 2], -v[:, 1], v[:, 0]
    return out


def tangent(b: np.ndarray) -> np.ndarray:
    """Two unit vectors orthogonal to each bearing and to each other, (n, 3) -> (n, 2, 3)."""
    a = np.where((np.abs(b[:, 0]) < 0.7)[:, None], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    e1 = np.cross(b, a)
    e1 /= np.linalg.norm(e1, axis=1, keepdims=True)
    return np.stack([e1, np.cross(b, e1)], axis=1)


def residuals(R_WB: np.ndarray, p_WB: np.ndarray, X_W: np.ndarray, R_BC: np.ndarray, p_BC: np.ndarray,
              measured: Bearings, focal: float) -> Residuals:
    """Residuals of points seen from body poses.

    u = unit(R_BC^T (R_WB^T (X - p_WB) - p_BC)), r = B (b - u) with B the tangent basis at the measured b.

    Args:
        R_WB, p_WB: body poses, shapes (n, 3, 3), (n, 3).
        X_W: points, shape (n, 3).
        R_BC, p_BC: extrinsics, shapes (3, 3), (3,).
        measured: n bearings.
        focal: relative focal error.
    """
    b = corrected(measured, focal)
    X_B = np.einsum("nji,nj->ni", R_WB, X_W - p_WB)
    X_C = (X_B - p_BC) @ R_BC
    distance = np.sqrt((X_C * X_C).sum(axis=1))
    u = X_C / distance[:, None]
    B = tangent(b)
    Bu = np.einsum("nij,nj->ni", B, u)
    by_X_C = (B - Bu[:, :, None] * u[:, None, :]) / distance[:, None, None]
    by_X_B = by_X_C @ R_BC.T
    by_X_W = by_X_B @ np.swapaxes(R_WB, 1, 2)
    return Residuals(
        r=-Bu, by_theta=by_X_B @ skew(X_B), by_position=-by_X_W, by_point=by_X_W,
        by_camera_rotation=by_X_C @ skew(X_C), by_camera_position=-by_X_B,
        by_focal=-np.einsum("nij,nj->ni", B, measured.by_focal), cosine=(u * b).sum(axis=1), distance=distance)
