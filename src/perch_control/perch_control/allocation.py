"""Rotor thrusts from a wanted wrench when rotors saturate: yaw is given up first, then thrust, tilt last.

The rotor thrusts that give collective thrust T, tilt moment (Mx, My) and yaw moment Mz are affine in all of them,
`f_i = a_i T + t_i(Mx, My) + d_i Mz`, and bounded, `lo_i <= f_i <= hi_i`. The three priorities are three nested linear
programs in one unknown each. Eliminating the unknowns of lower priority (Fourier-Motzkin) leaves finitely many linear
bounds, so each is solved exactly by comparing at most 72 ratios: no iteration, no sampling.
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
def _tilt_share(lo, hi, base, step, a, d):
    """Largest share s <= 1 of the tilt step for which some T and Mz keep all rotors within their bounds.

    `base` is the part of the rotor thrusts that the tilt moment of a feasible point takes, `step` what is missing.
    """
    zero = (0.0, 0.0, 0.0, 0.0)
    s = 1.0
    for i in range(4):
        for j in range(4):
            c, r = _thrust_row(i, j, lo, hi, base, a, d)
            _, q = _thrust_row(i, j, zero, zero, step, a, d)  # the bound is c T <= r + q s
            if abs(c) <= _TINY:
                if q < -_TINY:
                    s = min(s, max(r, 0.0) / -q)
                continue
            if c < 0.0:
                continue
            for m in range(4):
                for n in range(4):
                    c2, r2 = _thrust_row(m, n, lo, hi, base, a, d)
                    if c2 < -_TINY:
                        _, q2 = _thrust_row(m, n, zero, zero, step, a, d)
                        # (r2 + q2 s) / c2 <= T <= (r + q s) / c
                        slope = q2 / c2 - q / c
                        room = r / c - r2 / c2
                        if slope > _TINY:
                            s = min(s, max(room, 0.0) / slope)
    return s


@compiled
def _nearest(value, low, high):
    """The point of [low, high] nearest to a value; an interval that rounding has emptied counts as its middle."""
    if low > high:
        return 0.5 * (low + high)
    return min(max(value, low), high)


@compiled
def _sum(base, k, direction):
    """`base + k direction` for four rotors."""
    return (base[0] + k * direction[0], base[1] + k * direction[1], base[2] + k * direction[2], base[3] + k * direction[3])


@compiled
def allocate(wrench, reachable_tilt, lo, hi, mixing):
    """Rotor thrusts for a wanted wrench, by priority: tilt, then thrust, then yaw.

    Args:
        wrench: collective thrust [N] and moments Mx, My, Mz in B [N m], 4 floats.
        reachable_tilt: a tilt moment (Mx, My) that some thrusts within the bounds have [N m]; (0, 0) where all rotors
            have the same bounds. What cannot be had of the tilt moment is given up on the straight way towards it.
        lo, hi: bounds of each rotor's thrust [N], 4 floats each.
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
    base = _sum(_sum(zero, reachable_tilt[0], x), reachable_tilt[1], y)
    step = _sum(wanted, -1.0, base)
    tilt = _sum(base, _tilt_share(lo, hi, base, step, a, d), step)
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
