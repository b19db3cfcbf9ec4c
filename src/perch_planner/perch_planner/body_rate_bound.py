"""A proved bound on the body rate that flatness commands. [M:eq13]

With f = a + g e3, j the jerk and x = f x j, and d = b2_des of the yaw psi,

    w_x^2 + w_y^2 = |x|^2 / |f|^4                                                   (Lagrange's identity on [M:eq10])
    w_z = (psi' f_z |f| + (d . f)(d . x) / |f|) / (|f|^2 - (d . f)^2)                             (from [M:eq12])

The tilt part is a quotient of polynomials of degree 48: `|x|^2 <= u |f|^4` is one polynomial inequality, decided by
its Bernstein coefficients. The spin part holds sines of a polynomial: it is bounded on each subinterval from the
enclosures of its parts and taken off the squared limit, u = W^2 - w_z^2.
"""

from __future__ import annotations

from math import cos, sin, sqrt

import numpy as np

from perch_core.jit import compiled
from perch_planner.bounds import BELOW, UNDECIDED, VIOLATED, bernstein_row, cross, derivative, dot, product, split

_DEPTH = 20
_NODES = 3000
_TILT = 49          # coefficients of degree 48
_LAYOUT = ((0, 49), (1, 49), (2, 25), (3, 13), (4, 13), (5, 13), (6, 24), (7, 24), (8, 24), (9, 15), (10, 14))
_PARTS = 11         # rows of a node: |f|^4, |x|^2, |f|^2, f (3), x (3), psi, psi'


@compiled
def _elevate(coefficients, size):
    """The same polynomial with `size` coefficients."""
    out = coefficients
    while len(out) < size:
        n = len(out)
        raised = np.empty(n + 1)
        raised[0] = out[0]
        raised[n] = out[n - 1]
        for i in range(1, n):
            raised[i] = (i * out[i - 1] + (n - i) * out[i]) / n
        out = raised
    return out


@compiled
def rate_parts(force, jerk, yaw, duration):
    """Bernstein coefficients of what the body rate consists of.

    Args:
        force: f, shape (3, 13) [m/s^2].
        jerk: shape (3, 12) [m/s^3].
        yaw: shape (15,) [rad].
        duration: of the segment [s].

    Returns:
        Rows |f|^4 (49), |x|^2 (49), |f|^2 (25), f (3 x 13), x (3 x 24), psi (15), psi' (14), padded with zeros.
    """
    parts = np.zeros((_PARTS, _TILT))
    x = cross(force, jerk)
    squared = dot(force, force)
    parts[0] = product(squared, squared)
    parts[1] = _elevate(dot(x, x), _TILT)
    parts[2, :25] = squared
    parts[3:6, :13] = force
    parts[6:9, :24] = x
    parts[9, :15] = yaw
    parts[10, :14] = derivative(yaw, 1) / duration
    return parts


@compiled
def rate_coarse_bound(force, jerk, yaw, duration):
    """A quick upper bound of |omega| on a segment from |x| <= |f| |j|; infinite where it is of no use.

    Args:
        force, jerk, yaw, duration: as for `rate_parts`.
    """
    squared = dot(force, force)
    least, most = squared.min(), squared.max()
    if least <= 0.0:
        return np.inf
    low, high = yaw.min(), yaw.max()
    middle = 0.5 * (low + high)
    lean = np.abs(cos(middle) * force[1] - sin(middle) * force[0]).max() + 0.5 * (high - low) * sqrt(most)
    across = least - lean * lean
    if across <= 0.0:
        return np.inf
    j = sqrt(max(dot(jerk, jerk).max(), 0.0))
    turn = np.abs(derivative(yaw, 1)).max() / duration
    spin = (turn * np.abs(force[2]).max() * sqrt(most) + lean * j) / across
    return sqrt(j * j / least + spin * spin)


@compiled
def _squared_rate(parts):
    """|omega|^2 where the parts begin."""
    f_z, yaw, yaw_rate = parts[5, 0], parts[9, 0], parts[10, 0]
    f2 = max(parts[2, 0], 1e-30)
    specific = sqrt(f2)
    dx, dy = -sin(yaw), cos(yaw)
    along = dx * parts[3, 0] + dy * parts[4, 0]
    turning = dx * parts[6, 0] + dy * parts[7, 0]
    across = f2 - along * along
    if across < 1e-12:
        return np.inf
    spin = (yaw_rate * f_z * specific + along * turning / specific) / across
    return parts[1, 0] / max(parts[0, 0], 1e-60) + spin * spin


@compiled
def _interval_product(a, b, c, d):
    """Enclosure of x y for x in [a, b], y in [c, d]."""
    p, q, r, t = a * c, a * d, b * c, b * d
    return min(min(p, q), min(r, t)), max(max(p, q), max(r, t))


@compiled
def _along(parts, row, size, dx, dy, slack):
    """Enclosure of d . v for the vector polynomial at `row`, d within an arc whose effect is at most `slack`."""
    low, high = np.inf, -np.inf
    for k in range(size):
        value = dx * parts[row, k] + dy * parts[row + 1, k]
        low, high = min(low, value), max(high, value)
    return low - slack, high + slack


@compiled
def _spin_bound(parts):
    """Upper bound of |w_z| over the interval of the parts; infinite where the enclosure is too wide."""
    low, high = parts[9, :15].min(), parts[9, :15].max()
    middle, reach = 0.5 * (low + high), 0.5 * (high - low)
    dx, dy = -sin(middle), cos(middle)
    least, most = parts[2, :25].min(), parts[2, :25].max()
    if least <= 0.0:
        return np.inf
    shortest, longest = sqrt(least), sqrt(most)
    lean_low, lean_high = _along(parts, 3, 13, dx, dy, reach * longest)
    turn_low, turn_high = _along(parts, 6, 24, dx, dy, reach * sqrt(max(parts[1].max(), 0.0)))
    across = least - max(lean_low * lean_low, lean_high * lean_high)
    if across <= 0.0:
        return np.inf
    a, b = _interval_product(parts[10, :14].min(), parts[10, :14].max(), parts[5, :13].min(), parts[5, :13].max())
    a, b = _interval_product(a, b, shortest, longest)
    c, d = _interval_product(lean_low, lean_high, turn_low, turn_high)
    c, d = _interval_product(c, d, 1.0 / longest, 1.0 / shortest)
    return max(abs(a + c), abs(b + d)) / across


@compiled
def _split_parts(parts, left, right):
    """Halve the interval of all parts."""
    split(parts[0].copy(), left[0], right[0])
    split(parts[1].copy(), left[1], right[1])
    split(parts[2, :25].copy(), left[2, :25], right[2, :25])
    for k in range(3, 6):
        split(parts[k, :13].copy(), left[k, :13], right[k, :13])
    for k in range(6, 9):
        split(parts[k, :24].copy(), left[k, :24], right[k, :24])
    split(parts[9, :15].copy(), left[9, :15], right[9, :15])
    split(parts[10, :14].copy(), left[10, :14], right[10, :14])


@compiled
def _positive(room, parts):
    """Whether room |f|^4 - |x|^2 has only positive coefficients."""
    for k in range(_TILT):
        if room * parts[0, k] <= parts[1, k]:
            return False
    return True


@compiled
def rate_stays_below(parts, limit):
    """Whether |omega| stays below a limit on a segment.

    Args:
        parts: of `rate_parts`.
        limit: [rad/s].

    Returns:
        (verdict, place) as `bounds.stays_below`.
    """
    squared = limit * limit
    if _squared_rate(parts) >= squared:
        return VIOLATED, 0.0
    spin = _spin_bound(parts)
    room = squared - spin * spin
    if room > 0.0 and _positive(room, parts):
        return BELOW, 0.0
    stack = np.empty((_DEPTH + 2, _PARTS, _TILT))
    start = np.zeros(_DEPTH + 2)
    depth = np.zeros(_DEPTH + 2, np.int64)
    left = np.empty((_PARTS, _TILT))
    right = np.empty((_PARTS, _TILT))
    stack[0] = parts
    top, nodes = 1, 0
    doubtful = -1.0
    while top > 0:
        top -= 1
        nodes += 1
        spin = _spin_bound(stack[top])
        room = squared - spin * spin
        if room > 0.0 and _positive(room, stack[top]):
            continue
        if depth[top] >= _DEPTH or nodes >= _NODES:
            doubtful = start[top]
            continue
        level, begin = depth[top] + 1, start[top]
        _split_parts(stack[top], left, right)
        middle = begin + 0.5**level
        if _squared_rate(right) >= squared:
            return VIOLATED, middle
        stack[top], start[top], depth[top] = right, middle, level
        stack[top + 1], start[top + 1], depth[top + 1] = left, begin, level
        top += 2
    if doubtful >= 0.0:
        return UNDECIDED, doubtful
    return BELOW, 0.0


@compiled
def rate_at(parts, s):
    """|omega| at one place of a segment."""
    at = np.zeros((_PARTS, 1))
    for row, size in _LAYOUT:
        weights = bernstein_row(size - 1, s)
        at[row, 0] = (weights * parts[row, :size]).sum()
    return sqrt(_squared_rate(at))
