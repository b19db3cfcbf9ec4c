"""A proved bound on the body rate of a plan, from differential flatness. [M:eq13]

With f = a + g e3, j the jerk and x = f x j, and d = b2_des of the yaw psi,

    w_x^2 + w_y^2 = |x|^2 / |f|^4                                                   (Lagrange's identity on [M:eq10])
    w_z = (psi' f_z |f| + (d . f)(d . x) / |f|) / (|f|^2 - (d . f)^2)                             (from [M:eq12])

The tilt part is a quotient of polynomials of degree 48: `|x|^2 <= u |f|^4` holds on a subinterval where u is the largest
quotient of their Bernstein coefficients. The spin part contains sines of a polynomial: it is bounded on each subinterval
from the enclosures of its parts, and added in squares, |omega|^2 <= u + w_z^2.
"""

from __future__ import annotations

from math import cos, sin, sqrt

import numpy as np

from perch_core.arrays import Array
from perch_core.jit import compiled
from perch_planner.bounds import (
    cross,
    derivative,
    elevated,
    largest,
    magnitude,
    smallest,
    split,
    squared,
)

_DEPTH = 20
_NODES = 3000
RATE_SLACK = 1.04   # of a proved bound above the largest rate that is attained
_ROUNDING = 1e-9    # bounds are widened by this share
_TILT = 49          # coefficients of degree 48
_SIZES = np.array([49, 49, 25, 13, 13, 13, 24, 24, 24, 15, 14])  # of the rows |f|^4, |x|^2, |f|^2, f, x, psi, psi'
_PARTS = len(_SIZES)


@compiled
def rate_parts(force: Array, force2: Array, jerk: Array, yaw: Array, duration: float) -> Array:
    """Bernstein coefficients of the polynomials in the body rate.

    Args:
        force, force2: f and |f|^2, shapes (3, 13) and (25,) [m/s^2].
        jerk: shape (3, 12) [m/s^3].
        yaw: shape (15,) [rad].
        duration: of the segment [s].

    Returns:
        Rows |f|^4 (49), |x|^2 (49), |f|^2 (25), f (3 x 13), x (3 x 24), psi (15), psi' (14), padded with zeros.
    """
    parts = np.zeros((_PARTS, _TILT))
    x = cross(force, jerk)
    fourth, tilt, turn = squared(force2.reshape((1, 25))), elevated(squared(x), _TILT), derivative(yaw, 1)
    for k in range(_TILT):
        parts[0, k], parts[1, k] = fourth[k], tilt[k]
    for k in range(25):
        parts[2, k] = force2[k]
    for d in range(3):
        for k in range(13):
            parts[3 + d, k] = force[d, k]
        for k in range(24):
            parts[6 + d, k] = x[d, k]
    for k in range(15):
        parts[9, k] = yaw[k]
    for k in range(14):
        parts[10, k] = turn[k] / duration
    return parts


@compiled
def rate_coarse_bound(force: Array, force2: Array, jerk: Array, yaw: Array, duration: float) -> float:
    """A quick upper bound of |omega| on a segment from |x| <= |f| |j|; infinite where the bound fails.

    Args:
        force, force2, jerk, yaw, duration: as for `rate_parts`.
    """
    least, most = smallest(force2), largest(force2)
    if least <= 0.0:
        return np.inf
    low, high = smallest(yaw), largest(yaw)
    middle = 0.5 * (low + high)
    lean = 0.0
    for k in range(force.shape[1]):
        lean = max(lean, abs(cos(middle) * force[1, k] - sin(middle) * force[0, k]))
    lean += 0.5 * (high - low) * sqrt(most)
    across = least - lean * lean
    if across <= 0.0:
        return np.inf
    j = sqrt(max(largest(squared(jerk)), 0.0))
    turn = magnitude(derivative(yaw, 1)) / duration
    spin = (turn * magnitude(force[2]) * sqrt(most) + lean * j) / across
    return sqrt(j * j / least + spin * spin)


@compiled
def spin_rate(f_x: float, f_y: float, f_z: float, x_x: float, x_y: float, yaw: float, yaw_rate: float) -> float:
    """w_z for components of f and x = f x j [rad/s]; large where f is parallel to b2_des and the heading is undefined."""
    specific = sqrt(max(f_x * f_x + f_y * f_y + f_z * f_z, 1e-12))
    d_x, d_y = -sin(yaw), cos(yaw)
    lean = d_x * f_x + d_y * f_y
    across = max(specific * specific - lean * lean, 1e-12)
    return (yaw_rate * f_z * specific + lean * (d_x * x_x + d_y * x_y) / specific) / across


@compiled
def squared_rate(f_x: float, f_y: float, f_z: float, j_x: float, j_y: float, j_z: float, yaw: float, yaw_rate: float) -> float:
    """|omega|^2 for components of f and of the jerk [rad^2/s^2]. [M:eq13]"""
    f2 = max(f_x * f_x + f_y * f_y + f_z * f_z, 1e-12)
    x_x, x_y, x_z = f_y * j_z - f_z * j_y, f_z * j_x - f_x * j_z, f_x * j_y - f_y * j_x
    spin = spin_rate(f_x, f_y, f_z, x_x, x_y, yaw, yaw_rate)
    return (x_x * x_x + x_y * x_y + x_z * x_z) / (f2 * f2) + spin * spin


@compiled
def _squared_rate(parts: Array) -> float:
    """|omega|^2 at the start of the interval of the parts."""
    spin = spin_rate(parts[3, 0], parts[4, 0], parts[5, 0], parts[6, 0], parts[7, 0], parts[9, 0], parts[10, 0])
    tilt: float = parts[1, 0] / max(parts[0, 0], 1e-60)
    return tilt + spin * spin


@compiled
def _interval_product(a: float, b: float, c: float, d: float) -> tuple[float, float]:
    """Enclosure of x y for x in [a, b], y in [c, d]."""
    p, q, r, t = a * c, a * d, b * c, b * d
    return min(min(p, q), min(r, t)), max(max(p, q), max(r, t))


@compiled
def _along(parts: Array, row: int, size: int, dx: float, dy: float, slack: float) -> tuple[float, float]:
    """Enclosure of d . v for the vector polynomial at `row`, d within an arc whose effect is at most `slack`."""
    low, high = np.inf, -np.inf
    for k in range(size):
        value = dx * parts[row, k] + dy * parts[row + 1, k]
        low, high = min(low, value), max(high, value)
    return low - slack, high + slack


@compiled
def _spin_bound(parts: Array) -> float:
    """Upper bound of |w_z| over the interval of the parts; infinite where the enclosure is too wide."""
    low, high = smallest(parts[9, :15]), largest(parts[9, :15])
    middle, reach = 0.5 * (low + high), 0.5 * (high - low)
    dx, dy = -sin(middle), cos(middle)
    least, most = smallest(parts[2, :25]), largest(parts[2, :25])
    if least <= 0.0:
        return np.inf
    shortest, longest = sqrt(least), sqrt(most)
    lean_low, lean_high = _along(parts, 3, 13, dx, dy, reach * longest)
    turn_low, turn_high = _along(parts, 6, 24, dx, dy, reach * sqrt(max(largest(parts[1]), 0.0)))
    across: float = least - max(lean_low * lean_low, lean_high * lean_high)
    if across <= 0.0:
        return np.inf
    a, b = _interval_product(smallest(parts[10, :14]), largest(parts[10, :14]), smallest(parts[5, :13]), largest(parts[5, :13]))
    a, b = _interval_product(a, b, shortest, longest)
    c, d = _interval_product(lean_low, lean_high, turn_low, turn_high)
    c, d = _interval_product(c, d, 1.0 / longest, 1.0 / shortest)
    return max(abs(a + c), abs(b + d)) / across


@compiled
def _split_parts(parts: Array, left: Array) -> None:
    """Halve the interval of all parts: the left halves are written to `left`, `parts` become the right ones."""
    for row in range(_PARTS):
        size = _SIZES[row]
        split(parts[row, :size], left[row, :size])


@compiled
def _rate_bound(parts: Array) -> float:
    """Upper bound of |omega| over the interval of the parts; infinite where the enclosure is too wide."""
    tilt = 0.0
    for k in range(_TILT):
        if parts[0, k] <= 0.0:
            return np.inf
        tilt = max(tilt, parts[1, k] / parts[0, k])
    spin = _spin_bound(parts)
    return sqrt(tilt + spin * spin) * (1.0 + _ROUNDING)


@compiled
def rate_maximum(parts: Array, attained: float, limit: float) -> tuple[float, float, float]:
    """Largest |omega| on a segment, enclosed as far as it exceeds what is attained elsewhere. [M:alg1]

    Args:
        parts: of `rate_parts`.
        attained: a rate that the plan attains elsewhere [rad/s].
        limit: of the rate, against which the decision is exact [rad/s].

    Returns:
        (attained, proved, place): the largest attained rate found, at `place` of this segment or, with place -1, elsewhere;
        and a proved upper bound, at most 4 % above it and within a limit that holds. `proved` is infinite where the limit
        is violated, which ends the search, or where the proof fails near `place`.
    """
    stack = np.empty((_DEPTH + 2, _PARTS, _TILT))
    start = np.zeros(_DEPTH + 2)
    depth = np.zeros(_DEPTH + 2, np.int64)
    for row in range(_PARTS):
        for k in range(_TILT):
            stack[0, row, k] = parts[row, k]
    proved, place = 0.0, -1.0
    here = sqrt(_squared_rate(stack[0]))
    if here > attained:
        attained, place = here, 0.0
    top, nodes = 1, 0
    while top > 0:
        top -= 1
        nodes += 1
        if attained >= limit:
            return attained, np.inf, place
        bound = _rate_bound(stack[top])
        if bound <= min(RATE_SLACK * attained, limit):
            proved = max(proved, bound)
            continue
        if depth[top] >= _DEPTH or nodes >= _NODES:
            return attained, np.inf, start[top]
        level, begin = depth[top] + 1, start[top]
        _split_parts(stack[top], stack[top + 1])
        middle = begin + 0.5**level
        here = sqrt(_squared_rate(stack[top]))
        if here > attained:
            attained, place = here, middle
        start[top], depth[top] = middle, level
        start[top + 1], depth[top + 1] = begin, level
        top += 2
    return attained, proved, place


@compiled
def prove_rate(forces: Array, squares: Array, jerks: Array, yaw: Array, durations: Array, coarse: Array, limit: float, sampled: float
               ) -> tuple[float, int, float, int, float]:
    """Prove a bound of the body rate near the greatest attained one, or find where the limit fails.

    Args:
        forces, squares, jerks, yaw, durations: of all segments, as for `rate_parts`.
        coarse: from `rate_coarse_bound`, shape (f,) [rad/s].
        limit: of the rate [rad/s].
        sampled: an attained rate below the limit [rad/s].

    Returns:
        (proved, failed, failed_at, found, found_at): the proved bound, or infinity and segment and place where the proof of the
        limit fails; segment and place of a rate above the sampled one; segments are -1 where there is none.
    """
    found, found_at = -1, 0.0
    attained, most = sampled, sampled
    for i in range(len(durations)):
        proved = coarse[i]
        if proved > min(RATE_SLACK * attained, limit):
            parts = rate_parts(forces[i], squares[i], jerks[i], yaw[i], durations[i])
            attained, proved, place = rate_maximum(parts, attained, limit)
            if place >= 0.0:
                found, found_at = i, place
            if proved > limit:
                return np.inf, i, max(place, 0.0), found, found_at
        most = max(most, proved)
    return most, -1, 0.0, found, found_at
