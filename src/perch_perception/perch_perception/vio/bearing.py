"""Camera measurement of a point: a unit bearing, its residual against a prediction, and all derivatives.

Bearings are used instead of pixels: on a fisheye a pixel's error is nearly the same angle everywhere, and nothing is singular at
90 deg from the axis. A residual is a pair of tangent coordinates at the measured bearing, [rad].
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from perch_core.camera import Camera, EquidistantCamera
from perch_core.jit import compiled

from perch_perception.vio import lens


@dataclass(frozen=True)
class Bearings:
    """n measured bearings.

    Attributes:
        b_C: unit vectors in C, shape (n, 3).
        shape: local lens model, d theta / d r and r / theta; r: radius in the normalised image at the angle theta, shape (n, 2).
        noise: ratio of each bearing's 1 sigma to the camera's `track`, shape (n,); None: 1.
    """

    b_C: np.ndarray
    shape: np.ndarray
    noise: np.ndarray | None = None

    def chosen(self, rows: np.ndarray) -> Bearings:
        """Return a selection of the bearings, by index or mask."""
        return Bearings(self.b_C[rows], self.shape[rows], None if self.noise is None else self.noise[rows])


# columns of a residual's derivatives
CAMERA_ROTATION, CAMERA_POSITION, TIME_OFFSET, LENS = slice(0, 3), slice(3, 6), 6, slice(7, 11)
THETA, POSITION, POINT = slice(11, 14), slice(14, 17), slice(17, 20)


@dataclass(frozen=True)
class Residuals:
    """Residuals of n observations and their derivatives (r = J x + n).

    Attributes:
        r: measured minus predicted, shape (n, 2).
        J: derivatives with respect to the errors of camera rotation (3) and position (3), time offset, lens (log fx, log fy,
            cx / fx, cy / fy), the body's theta (3) and position (3), and the point's position in W (3), shape (n, 2, 20). The
            column of the time offset is zero: the offset acts through the poses (`State.add_clone`).
        cosine: between measured and predicted bearing, shape (n,).
        distance: from the camera to the point [m], shape (n,).
    """

    r: np.ndarray
    J: np.ndarray
    cosine: np.ndarray
    distance: np.ndarray


def observe(camera: Camera, pixels: np.ndarray) -> Bearings:
    """Return the bearings of pixels, shape (n, 2)."""
    if isinstance(camera, EquidistantCamera):
        return Bearings(*lens.observe(camera, pixels))
    b = camera.unproject(pixels)
    return Bearings(b, camera.shape_at(np.arctan2(np.hypot(b[:, 0], b[:, 1]), b[:, 2])))


@compiled
def _linearise(R_WB, p_WB, X_W, R_BC, p_BC, b_C, shape, r, J, cosine, distance):
    """Fill r, J, cosine, distance of `Residuals`; loops because the overhead of numpy calls exceeds the arithmetic."""
    X_B, X_C, u, b, e = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3)
    by_C, by_B = np.zeros(3), np.zeros(3)
    for n in range(X_W.shape[0]):
        for i in range(3):
            b[i] = b_C[n, i]
            X_B[i] = 0.0
            for j in range(3):
                X_B[i] += R_WB[n, j, i] * (X_W[n, j] - p_WB[n, j])
        d2 = 0.0
        for i in range(3):
            X_C[i] = 0.0
            for j in range(3):
                X_C[i] += R_BC[j, i] * (X_B[j] - p_BC[j])
            d2 += X_C[i] * X_C[i]
        d = math.sqrt(d2)
        distance[n], cosine[n] = d, 0.0
        for i in range(3):
            u[i] = X_C[i] / d
            cosine[n] += u[i] * b[i]
        # the lens at the prediction: at the measurement its derivatives are correlated with the residual's noise
        rho = math.sqrt(u[0] * u[0] + u[1] * u[1])
        theta = math.atan2(rho, u[2])
        cx, cy = (u[0] / rho, u[1] / rho) if rho > 1e-9 else (1.0, 0.0)
        radius = shape[n, 1] * theta  # the lens's shape hardly changes over a residual
        x, y = radius * cx, radius * cy
        out, side = shape[n, 0], rho / radius if rho > 1e-9 else 1.0
        # e1, e2: the axes of the image, turned as the optical axis is turned onto b, so that they keep their direction along a track,
        # as its random walk does (`sliding`); e2 = b x e1
        w = b[0] / (1.0 + b[2])
        e[0], e[1], e[2] = 1.0 - w * b[0], -w * b[1], -b[0]
        for row in range(2):
            if row == 1:
                e0, e1, e2 = b[1] * e[2] - b[2] * e[1], b[2] * e[0] - b[0] * e[2], b[0] * e[1] - b[1] * e[0]
                e[0], e[1], e[2] = e0, e1, e2
            eu = e[0] * u[0] + e[1] * u[1] + e[2] * u[2]
            r[n, row] = -eu
            for i in range(3):
                by_C[i] = (e[i] - eu * u[i]) / d
            for i in range(3):
                by_B[i] = R_BC[i, 0] * by_C[0] + R_BC[i, 1] * by_C[1] + R_BC[i, 2] * by_C[2]
            to = J[n, row]
            to[6] = 0.0
            along = out * (u[2] * (e[0] * cx + e[1] * cy) - e[2] * rho)
            across = side * (e[1] * cx - e[0] * cy)
            to[9], to[10] = along * cx - across * cy, along * cy + across * cx
            to[7], to[8] = to[9] * x, to[10] * y
            for i in range(3):
                j, k = (i + 1) % 3, (i + 2) % 3
                to[i] = by_C[j] * X_C[k] - by_C[k] * X_C[j]       # d X_C = X_C x dtheta_c
                to[3 + i] = -by_B[i]
                to[11 + i] = by_B[j] * X_B[k] - by_B[k] * X_B[j]
                by_W = R_WB[n, i, 0] * by_B[0] + R_WB[n, i, 1] * by_B[1] + R_WB[n, i, 2] * by_B[2]
                to[14 + i], to[17 + i] = -by_W, by_W


def residuals(R_WB: np.ndarray, p_WB: np.ndarray, X_W: np.ndarray, R_BC: np.ndarray, p_BC: np.ndarray,
              measured: Bearings) -> Residuals:
    """Return the residuals of points seen from body poses.

    u = unit(R_BC^T (R_WB^T (X - p_WB) - p_BC)), r = B (b - u) with B the tangent basis at the measured b.

    Args:
        R_WB, p_WB: body poses, shapes (n, 3, 3), (n, 3).
        X_W: points, shape (n, 3).
        R_BC, p_BC: extrinsics, shapes (3, 3), (3,).
        measured: n bearings.
    """
    n = len(X_W)
    out = Residuals(np.empty((n, 2)), np.empty((n, 2, 20)), np.empty(n), np.empty(n))
    _linearise(np.ascontiguousarray(R_WB), np.ascontiguousarray(p_WB), np.ascontiguousarray(X_W), np.ascontiguousarray(R_BC),
               p_BC, measured.b_C, measured.shape, out.r, out.J, out.cosine, out.distance)
    return out
