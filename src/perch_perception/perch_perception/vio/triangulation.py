"""Triangulation of a point from its bearings in several poses: linear solution, then Gauss-Newton on the bearings' residuals."""

from __future__ import annotations

import math

import numpy as np

from perch_core.jit import compiled


@compiled
def _solve3(A, y, x):
    """Solve a symmetric 3 x 3 system by Cramer's rule; False where it is nearly singular."""
    c00 = A[1, 1] * A[2, 2] - A[1, 2] * A[2, 1]
    c01 = A[1, 2] * A[2, 0] - A[1, 0] * A[2, 2]
    c02 = A[1, 0] * A[2, 1] - A[1, 1] * A[2, 0]
    det = A[0, 0] * c00 + A[0, 1] * c01 + A[0, 2] * c02
    scale = (A[0, 0] + A[1, 1] + A[2, 2]) / 3.0
    if not abs(det) > 1e-12 * scale * scale * scale:
        return False
    c11 = A[0, 0] * A[2, 2] - A[0, 2] * A[2, 0]
    c12 = A[0, 1] * A[2, 0] - A[0, 0] * A[2, 1]
    c22 = A[0, 0] * A[1, 1] - A[0, 1] * A[1, 0]
    x[0] = (c00 * y[0] + c01 * y[1] + c02 * y[2]) / det
    x[1] = (c01 * y[0] + c11 * y[1] + c12 * y[2]) / det
    x[2] = (c02 * y[0] + c12 * y[1] + c22 * y[2]) / det
    return True


@compiled
def _triangulate(centres, rays, cos_parallax, limit, X):
    """Triangulate a point into `X` from camera centres (m, 3) and unit rays in W (m, 3); False where it is not usable."""
    m = centres.shape[0]
    least = 1.0
    for i in range(m):
        for j in range(i):
            c = rays[i, 0] * rays[j, 0] + rays[i, 1] * rays[j, 1] + rays[i, 2] * rays[j, 2]
            least = min(least, c)
    if least > cos_parallax:
        return False
    A, y, dx = np.zeros((3, 3)), np.zeros(3), np.zeros(3)
    for i in range(m):
        for r in range(3):
            for c in range(3):
                w = (1.0 if r == c else 0.0) - rays[i, r] * rays[i, c]
                A[r, c] += w
                y[r] += w * centres[i, c]
    if not _solve3(A, y, X):
        return False
    cost = 0.0
    for _ in range(5):
        A[:, :] = 0.0
        y[:] = 0.0
        cost = 0.0
        for i in range(m):
            v0, v1, v2 = X[0] - centres[i, 0], X[1] - centres[i, 1], X[2] - centres[i, 2]
            n = math.sqrt(v0 * v0 + v1 * v1 + v2 * v2)
            if n < 1e-3:
                return False
            u0, u1, u2 = v0 / n, v1 / n, v2 / n
            d0, d1, d2 = rays[i, 0], rays[i, 1], rays[i, 2]
            along = u0 * d0 + u1 * d1 + u2 * d2
            if along < 0.3:
                return False
            # residual d - u, taken orthogonal to u, where the derivative of u is (I - u u^T) / n
            e0, e1, e2 = d0 - along * u0, d1 - along * u1, d2 - along * u2
            cost += e0 * e0 + e1 * e1 + e2 * e2
            k = 1.0 / (n * n)
            A[0, 0] += k * (1.0 - u0 * u0)
            A[1, 1] += k * (1.0 - u1 * u1)
            A[2, 2] += k * (1.0 - u2 * u2)
            A[0, 1] -= k * u0 * u1
            A[0, 2] -= k * u0 * u2
            A[1, 2] -= k * u1 * u2
            y[0] += e0 / n
            y[1] += e1 / n
            y[2] += e2 / n
        A[1, 0], A[2, 0], A[2, 1] = A[0, 1], A[0, 2], A[1, 2]
        if not _solve3(A, y, dx):
            return False
        X[0] += dx[0]
        X[1] += dx[1]
        X[2] += dx[2]
        if abs(dx[0]) + abs(dx[1]) + abs(dx[2]) < 1e-5:
            break
    return math.isfinite(X[0] + X[1] + X[2]) and math.sqrt(cost / (2 * m)) < limit


def triangulate(centres_W: np.ndarray, rays_W: np.ndarray, least_parallax: float, noise: float) -> np.ndarray | None:
    """Return the position of a point seen from several camera poses.

    Args:
        centres_W: camera centres [m], shape (m, 3).
        rays_W: unit bearings turned into W, shape (m, 3).
        least_parallax: the largest angle between two rays must exceed this [rad].
        noise: 1 sigma of a bearing [rad]; a point with an RMS residual above 4 sigma is refused.

    Returns:
        X_W, shape (3,), or None without parallax, behind a camera, or with residuals too large.
    """
    X = np.zeros(3)
    if not _triangulate(np.ascontiguousarray(centres_W), np.ascontiguousarray(rays_W), math.cos(least_parallax), 4.0 * noise, X):
        return None
    return X
