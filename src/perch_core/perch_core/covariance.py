"""Summary of a covariance in one number, and the covariance that odometry drift adds."""

from __future__ import annotations

import numpy as np

from perch_core import so3
from perch_core.arrays import Array


def largest_sigma(covariance: Array) -> float:
    """Standard deviation along the worst axis: the root of the largest eigenvalue, in the root of the covariance's unit.

    Args:
        covariance: symmetric, shape (n, n); an eigenvalue that rounding has made slightly negative counts as zero.
    """
    return float(np.sqrt(max(0.0, np.linalg.eigvalsh(covariance)[-1])))


def drift(now: Array, before: Array, u_W: Array) -> Array:
    """Covariance that odometry drift since a sighting adds to the pose of a place relative to the vehicle.

    The odometry's error is the sum of independent increments, e_t = e_s + w, so that cov(w) = P_t - P_s. Of this difference only
    the positive semidefinite part is drift. w moves the vehicle, while the place stays where it was seen:
    J cov(w) J^T with J = [I, -[u]x; 0, I].

    Args:
        now: P_t, covariance of the odometry's pose (position in W, rotation about W's axes) [m, rad], shape (6, 6).
        before: P_s, the same at the sighting.
        u_W: vector from the vehicle to the place, in W [m], shape (3,).

    Returns:
        Covariance of (position, rotation) in the axes of W [m, rad], shape (6, 6).
    """
    values, vectors = np.linalg.eigh(now - before)
    J = np.eye(6)
    J[:3, 3:] = -so3.hat(u_W)
    J = J @ vectors
    added: Array = (J * np.clip(values, 0.0, None)) @ J.T
    return added
