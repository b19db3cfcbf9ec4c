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
    """Rays of the same points in two frames; with a leading axis in each field: of k pairs of frames.

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
    cost, db, N = _descend(_stacked(pairs), sigma, prior_sigma, begins)
    best = int(np.argmin(cost))
    return db[best], np.linalg.inv(N[best])


def _stacked(pairs: Sequence[RayPair]) -> RayPair:
    """Return all k pairs as one, with a leading axis of k; missing rays are zero and have no effect."""
    most = max((len(pair.first) for pair in pairs), default=0)
    first, second = np.zeros((2, len(pairs), most, 3))
    for k, pair in enumerate(pairs):
        first[k, : len(pair.first)], second[k, : len(pair.first)] = pair.first, pair.second
    return RayPair(np.array([pair.dR for pair in pairs]).reshape(-1, 3, 3), np.array([pair.J for pair in pairs]).reshape(-1, 3, 3), first, second)


def _descend(pairs: RayPair, sigma: float, prior_sigma: float, db: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Run Gauss-Newton from each of m initial values (m, 3), at once; return final costs (m,), corrections (m, 3), information (m, 3, 3)."""
    for _ in range(_ITERATIONS):  # axes: initial value, pair, ray
        theta = np.einsum("kij,mj->mki", pairs.J, db)
        R = pairs.dR @ so3.exp(theta)
        turned = pairs.second @ R.swapaxes(-1, -2)
        n = np.cross(pairs.first, turned)
        t, U = _translation(n, sigma)
        e, across = (n @ t[..., None])[..., 0], np.cross(t[..., None, :], pairs.first)  # e = t . (f_i x R f_j) = (t x f_i) . R f_j
        by_bias = np.cross(pairs.second, across @ R) @ ((np.eye(3) - 0.5 * so3.hat(theta)) @ pairs.J)
        w = 1.0 / (sigma**2 * ((across**2).sum(axis=-1) + (np.cross(t[..., None, :], turned) ** 2).sum(axis=-1)) + 1e-16)
        cost = 4.0 * np.log1p(0.25 * w * e**2).sum(axis=(1, 2)) + (db**2).sum(axis=1) / prior_sigma**2
        w /= 1.0 + 0.25 * w * e**2  # Cauchy: what moves by itself hardly counts
        G_T, V = (w[..., None] * by_bias).swapaxes(-1, -2), n @ U
        V_T = V.swapaxes(-1, -2)
        cross = G_T @ V @ np.linalg.inv(V_T @ (w[..., None] * V) + np.eye(2))  # the unit is that of a direction nobody knows
        N = np.eye(3) / prior_sigma**2 + (G_T @ by_bias - cross @ (G_T @ V).swapaxes(-1, -2)).sum(axis=1)
        y = -db[..., None] / prior_sigma**2 - (G_T @ e[..., None] - cross @ (V_T @ (w * e)[..., None])).sum(axis=1)
        step = np.linalg.solve(N, y)[..., 0]
        db = db + step
        if np.abs(step).max() < 1e-5:
            break
    return cost, db, N


def _translation(n: np.ndarray, sigma: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the direction most nearly orthogonal to normals (..., m, 3), shape (..., 3), and two axes orthogonal to it, shape (..., 3, 2)."""
    length = (n**2).sum(axis=-1)
    weighed = n / np.sqrt(length + (4.0 * sigma) ** 2)[..., None]
    _, vectors = np.linalg.eigh(weighed.swapaxes(-1, -2) @ weighed)
    return vectors[..., 0], vectors[..., 1:]
