"""Rotor thrusts from a wanted wrench when rotors saturate: yaw is given up first, then thrust, tilt last.

The rotor thrusts that give collective thrust T, tilt moment (Mx, My) and yaw moment Mz are affine in all of them,
`f_i = a_i T + t_i(Mx, My) + d_i Mz`, and bounded, `lo_i <= f_i <= hi_i`. The attainable tilt moments form a polygon
whose edges are parallel to the rotors' levers (a zonogon); its point nearest to the wanted moment is chosen. Thrust and yaw are
nested linear programs in one unknown each: eliminating the unknowns of lower priority (Fourier-Motzkin) leaves finitely
many linear bounds. So the problem is solved exactly by comparing a few dozen numbers, without iteration or sampling.
"""

from __future__ import annotations

import numpy as np

from perch_core.jit import compiled
from perch_core.vehicle import Vehicle

_TINY = 1e-12  # coefficients below this are zero: the unknown does not act on that bound


@compiled
def _interval(lo, hi, offset, slope):
    """Range of y with `lo_i <= offset_i + slope_i y <= hi_i` for all i; empty where the first exceeds the second."""
    low, high = -1e300, 1e300
    for i in range(4):
        if abs(slope[i]) > _TINY:
            y0, y1 = (lo[i] - offset[i]) / slope[i], (hi[i] - offset[i]) / slope[i]
            low, high = max(low, min(y0, y1)), min(high, max(y0, y1))
    return low, high


@compiled
def _thrust_row(i, j, lo, hi, offset, a, d):
    """The bound on T that remains when Mz is eliminated from Mz >= bound i and Mz <= bound j: `c T <= r`."""
    # With k = 1/d > 0, Mz lies in [(lo - offset - a T) k, (hi - offset - a T) k]; with k < 0 the ends swap.
    ki, kj = 1.0 / d[i], 1.0 / d[j]
    edge_i = lo[i] if ki > 0.0 else hi[i]
    edge_j = hi[j] if kj > 0.0 else lo[j]
    return a[j] * kj - a[i] * ki, (edge_j - offset[j]) * kj - (edge_i - offset[i]) * ki


@compiled
def _thrust_interval(lo, hi, offset, a, d):
    """Range of T for which some Mz keeps all rotors within their bounds."""
    low, high = -1e300, 1e300
    for i in range(4):
        for j in range(4):
            c, r = _thrust_row(i, j, lo, hi, offset, a, d)
            if c > _TINY:
                high = min(high, r / c)
            elif c < -_TINY:
                low = max(low, r / c)
    return low, high


@compiled
def _support(n, low, high, levers):
    """Largest component of the attainable tilt moments along a direction `n`. [N m]"""
    total = 0.0
    for i in range(4):
        k = n[0] * levers[0][i] + n[1] * levers[1][i]
        total += max(k * low[i], k * high[i])
    return total


@compiled
def _tilt_share(wanted, floor, ceiling, levers):
    """Largest fraction <= 1 of a tilt moment that is attainable with every rotor thrust between `floor` and `ceiling`."""
    low, high = (floor, floor, floor, floor), (ceiling, ceiling, ceiling, ceiling)
    share = 1.0
    for i in range(4):
        for sign in (1.0, -1.0):
            n = (-sign * levers[1][i], sign * levers[0][i])
            demand = n[0] * wanted[0] + n[1] * wanted[1]
            if demand > _TINY:
                share = min(share, _support(n, low, high, levers) / demand)
    return share


@compiled
def _nearest_tilt(wanted, lo, hi, levers):
    """Tilt moment nearest to the wanted one that is attainable with rotor thrusts within their bounds [N m], 2 floats."""
    inside, best, least = True, wanted, 1e300
    for i in range(4):
        length = (levers[0][i] ** 2 + levers[1][i] ** 2) ** 0.5
        along = (levers[0][i] / length, levers[1][i] / length)
        for sign in (1.0, -1.0):
            n = (-sign * along[1], sign * along[0])
            reach = _support(n, lo, hi, levers)
            across = n[0] * wanted[0] + n[1] * wanted[1]
            if across > reach + _TINY:
                inside = False
            # The edge with this normal: rotors across it are at a bound, those whose levers lie along it are free.
            first, last = 0.0, 0.0
            for j in range(4):
                k = n[0] * levers[0][j] + n[1] * levers[1][j]
                m = along[0] * levers[0][j] + along[1] * levers[1][j]
                if abs(k) < 1e-9:
                    first, last = first + min(m * lo[j], m * hi[j]), last + max(m * lo[j], m * hi[j])
                else:
                    first, last = first + m * (hi[j] if k > 0.0 else lo[j]), last + m * (hi[j] if k > 0.0 else lo[j])
            place = along[0] * wanted[0] + along[1] * wanted[1]
            kept = min(max(place, first), last)
            distance = (across - reach) ** 2 + (place - kept) ** 2
            if distance < least:
                least = distance
                best = (reach * n[0] + kept * along[0], reach * n[1] + kept * along[1])
    return wanted if inside else best


@compiled
def _nearest(value, low, high):
    """The point of [low, high] nearest to a value; the middle where rounding has made the interval empty."""
    if low > high:
        return 0.5 * (low + high)
    return min(max(value, low), high)


@compiled
def _sum(base, k, direction):
    """`base + k direction` for four rotors."""
    return (base[0] + k * direction[0], base[1] + k * direction[1], base[2] + k * direction[2], base[3] + k * direction[3])


@compiled
def allocate(wrench, lo, hi, floor, ceiling, levers, mixing):
    """Rotor thrusts for a wanted wrench, by priority: tilt, then thrust, then yaw.

    A tilt moment that is not attainable between `floor` and `ceiling` is shortened in its direction; then the nearest one that
    is attainable between `lo` and `hi` is taken.

    Args:
        wrench: collective thrust [N] and moments Mx, My, Mz in B [N m], 4 floats.
        lo, hi: bounds of each rotor's thrust now [N], 4 floats each.
        floor, ceiling: bounds of every rotor's thrust in steady state [N].
        levers: moments Mx, My per thrust of each rotor [m], 2 x 4 floats.
        mixing: inverse of the allocation matrix by columns, ((a_i), (x_i), (y_i), (d_i)), 4 x 4 floats.

    Returns:
        Rotor thrusts within their bounds [N], 4 floats.
    """
    a, x, y, d = mixing
    zero = (0.0, 0.0, 0.0, 0.0)
    wanted = _sum(_sum(zero, wrench[1], x), wrench[2], y)
    f = _sum(_sum(wanted, wrench[0], a), wrench[3], d)
    inside = True
    for i in range(4):
        inside = inside and lo[i] <= f[i] and f[i] <= hi[i]
    if inside:
        return f
    share = _tilt_share((wrench[1], wrench[2]), floor, ceiling, levers)
    Mx, My = _nearest_tilt((share * wrench[1], share * wrench[2]), lo, hi, levers)
    tilt = _sum(_sum(zero, Mx, x), My, y)
    low, high = _thrust_interval(lo, hi, tilt, a, d)
    level = _sum(tilt, _nearest(wrench[0], low, high), a)
    low, high = _interval(lo, hi, level, d)
    f = _sum(level, _nearest(wrench[3], low, high), d)
    return (min(max(f[0], lo[0]), hi[0]), min(max(f[1], lo[1]), hi[1]),
            min(max(f[2], lo[2]), hi[2]), min(max(f[3], lo[3]), hi[3]))


def mixing_columns(vehicle: Vehicle) -> tuple[tuple[float, ...], ...]:
    """Inverse of the vehicle's allocation matrix by columns, as `allocate` takes it, 4 x 4 floats. [P:eq2]"""
    inverse = np.linalg.inv(vehicle.allocation)
    return tuple(tuple(float(v) for v in inverse[:, k]) for k in range(4))
