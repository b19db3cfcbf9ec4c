"""Gyro bias in motion from tracks: relative rotations that make the epipolar normals of all tracks coplanar.

Between frames i and j the preintegrated rotation is dR exp(J db) for a change db of the bias. Rays f_i, f_j of the same point,
and the unknown translation t, obey t . n = 0 with n = f_i x dR exp(J db) f_j (Kneip and Lynen 2013). One db for all pairs and one
t for each pair are solved for by least squares: Gauss-Newton with t eliminated (He et al., CVPR 2023: rotation without
translation or depth). Neither scale nor gravity enters, so the method works before there is a state.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from perch_core import so3

_ITERATIONS = 10


@dataclass(frozen=True)
class RayPair:
    """Rays of the same points in two frames.

    Attributes:
        dR: preintegrated rotation of the second frame in the first, shape (3, 3); J: its (right) derivative with respect to the
            bias, shape (3, 3).
        first, second: unit rays of the same points in B of each frame, shape (n, 3).
    """

    dR: np.ndarray
    J: np.ndarray
    first: np.ndarray
    second: np.ndarray


def solve_gyro_bias(pairs: Sequence[RayPair], sigma: float, prior_sigma: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the correction of the bias that was used in the preintegration.

    Args:
        pairs: no frame is in more than one of them, so that each ray counts once.
        sigma: 1 sigma of a ray [rad].
        prior_sigma: prior 1 sigma of the bias [rad/s].

    Returns:
        db [rad/s], shape (3,), and its covariance, shape (3, 3).
    """
    begins = prior_sigma * np.vstack([np.zeros(3), np.eye(3), -np.eye(3)])  # rotation and translation look alike: there are side minima
    return min((_descend(pairs, sigma, prior_sigma, db) for db in begins), key=lambda end: end[0])[1:]


def _descend(pairs: Sequence[RayPair], sigma: float, prior_sigma: float, db: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Run Gauss-Newton from `db` (3,); return the final cost, bias correction and covariance."""
    for _ in range(_ITERATIONS):
        N, y, cost = np.eye(3) / prior_sigma**2, -db / prior_sigma**2, float(db @ db) / prior_sigma**2
        for pair in pairs:
            theta = pair.J @ db
            R = pair.dR @ so3.exp(theta)
            turned = pair.second @ R.T
            n = np.cross(pair.first, turned)
            t, U = _translation(n, sigma)
            e, across = n @ t, np.cross(t, pair.first)  # e = t . (f_i x R f_j) = (t x f_i) . R f_j
            by_bias = np.cross(pair.second, across @ R) @ (np.eye(3) - 0.5 * so3.hat(theta)) @ pair.J
            w = 1.0 / (sigma**2 * ((across**2).sum(axis=1) + (np.cross(t, turned) ** 2).sum(axis=1)) + 1e-16)
            cost += float(np.log1p(0.25 * w * e**2).sum()) * 4.0
            w /= 1.0 + 0.25 * w * e**2  # Cauchy: what moves by itself hardly counts
            G, V = w[:, None] * by_bias, n @ U
            inverse = np.linalg.inv(V.T @ (w[:, None] * V) + np.eye(2))  # the unit is that of a direction nobody knows
            cross = G.T @ V
            N += G.T @ by_bias - cross @ inverse @ cross.T
            y -= G.T @ e - cross @ inverse @ (V.T @ (w * e))
        step = np.linalg.solve(N, y)
        db = db + step
        if np.abs(step).max() < 1e-5:
            break
    return cost, db, np.linalg.inv(N)


def _translation(n: np.ndarray, sigma: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the direction most nearly orthogonal to normals (m, 3), shape (3,), and two axes orthogonal to it, shape (3, 2)."""
    length = (n**2).sum(axis=1)
    weighed = n / np.sqrt(length + (4.0 * sigma) ** 2)[:, None]
    _, vectors = np.linalg.eigh(weighed.T @ weighed)
    return vectors[:, 0], vectors[:, 1:]
