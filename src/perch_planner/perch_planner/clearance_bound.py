"""Proved bounds on the distances of the vehicle's rim and of its velcro plate from the surface, until contact."""

from __future__ import annotations

import numpy as np

from perch_core.arrays import Array
from perch_core.jit import compiled
from perch_planner.bounds import BELOW, cross, maximum, product, smallest, squared, stays_below

_SLACK = 1e-9  # [m^4/s^4] the rim may touch the surface at the contact itself: clearance is proved to sqrt(_SLACK) / |f|, 16 um at 2 m/s^2
PLATE_SLACK = 1e-4  # [m] by which the plate may be behind the surface
_WIDTH = 1e-5  # of the enclosure of the least distance [m]


@compiled
def surface_distance(coefficients: Array, duration: float, begin: float, p_S: Array, v_S: Array, s3: Array) -> Array:
    """Distance of the centre of mass from the moving surface, Bernstein coefficients, shape (15,) [m]."""
    out = np.zeros(coefficients.shape[1])
    last = len(out) - 1
    for d in range(3):
        for k in range(last + 1):
            out[k] += s3[d] * (coefficients[d, k] - p_S[d] - v_S[d] * (begin + duration * k / last))
    return out


@compiled
def _rim_clears(distance: Array, force: Array, force2: Array, s3: Array, extension: float, gap: float) -> tuple[bool, float]:
    """Return whether distance - extension sin(tilt) > gap is proved on the segment, and a place where the proof fails.

    The rim of a disc around the centre of mass reaches extension sin(tilt) towards the surface, and
    sin(tilt) = |f x s3| / |f|: so (distance - gap)^2 |f|^2 > extension^2 |f x s3|^2 with distance > gap.
    """
    reduced = distance - gap
    verdict, place = stays_below(-reduced, _SLACK)
    if verdict != BELOW:
        return False, place
    tilt = cross(force, s3.reshape((3, 1)))
    far = product(squared(reduced.reshape((1, len(reduced)))), force2)
    near = product(squared(tilt), np.ones(len(far) - 24))
    for k in range(len(far)):
        near[k] = extension * extension * near[k] - far[k]
    verdict, place = stays_below(near, _SLACK)
    return verdict == BELOW, place


@compiled
def prove_clearance(distances: Array, forces: Array, squares: Array, s3: Array, extension: float, limit: float, sampled: float
                    ) -> tuple[float, int, float]:
    """Prove a clearance near the sampled one, else a lower one down to the limit, else find where the proof fails.

    Args:
        distances: from `surface_distance`, shape (f, 15) [m].
        forces, squares: f and |f|^2, shapes (f, 3, 13) and (f, 25).
        s3: outward normal, shape (3,).
        extension: radius of the vehicle's disc [m].
        limit: least distance of its rim from the surface [m].
        sampled: an attained clearance [m].

    Returns:
        (proved, segment, place): the proved clearance, or -inf and where the proof fails; segment -1 where it succeeds.
    """
    failed, place, gap, factor = -1, 0.0, np.inf, 1.0
    while gap > limit:
        gap = max(sampled - factor * 0.02 * abs(sampled) - factor * 1e-3, limit)
        factor *= 5.0
        failed = -1
        for i in range(len(distances)):
            if smallest(distances[i]) > gap + extension:
                continue
            clears, place = _rim_clears(distances[i], forces[i], squares[i], s3, extension, gap)
            if not clears:
                failed = i
                break
        if failed < 0:
            return gap, -1, 0.0
    return -np.inf, failed, place


@compiled
def least_distance(distances: Array, least: float) -> tuple[float, int, float]:
    """Least distance of the centre of mass from the surface, where it is below a limit.

    The plate is `perch_offset` below the centre of mass, `perch_offset cos(tilt)` nearer to the surface: a centre of mass that keeps
    `perch_offset` keeps the plate in front of the surface at any tilt. At larger tilts the rim is nearer than the plate.

    Args:
        distances: from `surface_distance`, shape (f, 15) [m].
        least: the limit [m].

    Returns:
        (proved, segment, place): a proved lower bound of the distance, and where it is attained nearly; segment -1 where the
        limit is kept to `_WIDTH`.
    """
    proved, segment, at = least - _WIDTH, -1, 0.0
    for i in range(len(distances)):
        if smallest(distances[i]) >= least:
            continue
        _, above, place = maximum(-distances[i], _WIDTH, -least)
        if -above < proved:
            proved, segment, at = -above, i, place
    return proved, segment, at
