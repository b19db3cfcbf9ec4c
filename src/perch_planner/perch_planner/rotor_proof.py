"""Proof that single rotors keep their range on a whole plan. [uses M:eq1, M:eq10, M:eq12, M:eq13, P:eq2]

The rotor thrusts that `rotor_thrusts` samples are not polynomials, but functions of polynomials: specific force, jerk and snap,
yaw and two derivatives. Around the middle of an interval each of these is a Taylor model of second order: its power expansion is
finite, and the absolute values of the higher terms bound the change of the second derivative. The same formulas in this
arithmetic (`taylor_models`) bound the thrust of each rotor. Eight intervals are evaluated at a time. They are halved where their
bounds exceed the limits, or are not close to attained values.
"""

from __future__ import annotations

from math import comb, cos, perm, sin

import numpy as np

from perch_core import bernstein
from perch_core.arrays import Array, Vector3
from perch_core.jit import compiled
from perch_planner.bounds import largest, smallest, split
from perch_planner.rotor_thrusts import motion, three_derivatives
from perch_planner.taylor_models import (
    ROUNDING, ZERO, Taylor, Vector, add, axpy, cross, dot, greatest, inverse_root, least, mul, scale, sine, sub, times, vector_add)

_LANES = 8                  # intervals at a time: what a processor's vector unit takes at once
_POWERS = 15
_DEPTH = 30
_NODES = 4000
_DURATION_MAX = 0.8         # [s] longer ones are halved at once: the models would be wide
_TIGHTNESS = 0.02           # proved bounds lie within this share of the range from what is attained
_SQUARED_LENGTH_MIN = 1e-6  # squared lengths that may be less have no direction

_MIDDLES = (np.arange(_LANES) + 0.5) / _LANES
_EXPANSION = np.hstack([comb(14, k) * (0.5 / _LANES) ** k * np.diff(np.eye(_POWERS), k) @ bernstein.basis(14 - k, _MIDDLES).T
                        for k in range(_POWERS)])
"""Map from Bernstein to power coefficients, in t in [-1, 1] around the middle of each lane, by power, then by lane."""

_ELEVATED = [perm(14, n) * bernstein.elevate(np.diff(np.eye(_POWERS), n), 14) for n in range(5)]
_DERIVATIVES = np.hstack(_ELEVATED[2:]), np.hstack(_ELEVATED[:3])
"""Maps like those of `rotor_thrusts.bases_at`, but to Bernstein coefficients of degree 14 instead of values."""

# Places in the work array: 12 models of the inputs, sine and cosine of the yaw, 4 models of the wrench, 4 rows of bounds.
_YAW_AT, _WRENCH_AT, _BOUNDS_AT = 48 * _LANES, 64 * _LANES, 80 * _LANES
_WRENCH_MODEL = 16


@compiled
def _build_models(rows: Array, powers: Array, work: Array) -> None:
    """Compute the Taylor models of all inputs in each lane.

    Args:
        rows: Bernstein coefficients, shape (12, 15).
        powers: receives the power coefficients, shape (12, 15 lanes).
        work: receives the models, each with its 4 numbers for all lanes.
    """
    np.dot(rows, _EXPANSION, powers)
    for n in range(12):
        at = 4 * _LANES * n
        for lane in range(_LANES):
            work[at + lane], work[at + _LANES + lane] = powers[n, lane], powers[n, _LANES + lane]
            work[at + 2 * _LANES + lane], work[at + 3 * _LANES + lane] = 2.0 * powers[n, 2 * _LANES + lane], 0.0
        for k in range(3, _POWERS):
            for lane in range(_LANES):
                work[at + 3 * _LANES + lane] += k * (k - 1) * abs(powers[n, _LANES * k + lane])


@compiled(inline=True)
def _model(work: Array, n: int, lane: int) -> Taylor:
    """The n-th model in a lane."""
    k = 4 * _LANES * n + lane
    return work[k], work[k + _LANES], work[k + 2 * _LANES], work[k + 3 * _LANES]


@compiled(inline=True)
def _vector_model(work: Array, n: int, lane: int) -> Vector:
    """The n-th derivative of the specific force."""
    return _model(work, 3 * n, lane), _model(work, 3 * n + 1, lane), _model(work, 3 * n + 2, lane)


@compiled(inline=True)
def _direction(f: Vector, df: Vector, ddf: Vector, k: Taylor) -> tuple[Vector, Vector, Vector]:
    """Taylor models of `flatness.direction_derivatives`, with k = 1 / |f|."""
    u = scale(k, f)
    dn = dot(u, df)
    du = scale(k, axpy(times(-1.0, dn), u, df))
    ddn = add(dot(du, df), dot(u, ddf))
    return u, du, scale(k, axpy(times(-2.0, dn), du, axpy(times(-1.0, ddn), u, ddf)))


@compiled(inline=True)
def _heading(yaw: Taylor, rate: Taylor, acceleration: Taylor, sin_yaw: float, cos_yaw: float) -> tuple[Vector, Vector, Vector]:
    """Taylor models of `flatness.heading_derivatives`."""
    s, c, squared = sine(yaw, sin_yaw, cos_yaw), sine(yaw, cos_yaw, -sin_yaw), mul(rate, rate)
    return ((times(-1.0, s), c, ZERO), (times(-1.0, mul(c, rate)), times(-1.0, mul(s, rate)), ZERO),
            (sub(mul(s, squared), mul(c, acceleration)), times(-1.0, add(mul(c, squared), mul(s, acceleration))), ZERO))


@compiled(inline=True)
def _wrench(f: Vector, df: Vector, ddf: Vector, h: Vector, dh: Vector, ddh: Vector, mass: float, J: Vector3
            ) -> tuple[bool, Taylor, Taylor, Taylor, Taylor]:
    """Return whether thrust and heading provably do not vanish, and models of the thrust [N] and of the moments [N m]."""
    squared = dot(f, f)
    inverse = inverse_root(squared)
    b3, db3, ddb3 = _direction(f, df, ddf, inverse)
    n, twist = cross(h, b3), cross(dh, db3)
    dn = vector_add(cross(dh, b3), cross(h, db3))
    ddn = vector_add(vector_add(cross(ddh, b3), cross(h, ddb3)), vector_add(twist, twist))
    across = dot(n, n)
    b1, db1, ddb1 = _direction(n, dn, ddn, inverse_root(across))
    b2 = cross(b3, b1)
    wx, wy, wz = times(-1.0, dot(b2, db3)), dot(b1, db3), dot(b2, db1)
    xy, yz, zx = mul(wx, wy), mul(wy, wz), mul(wz, wx)
    return ((least(squared) > _SQUARED_LENGTH_MIN) & (least(across) > _SQUARED_LENGTH_MIN), times(mass, mul(squared, inverse)),
            add(times(J[0], sub(yz, dot(b2, ddb3))), times(J[2] - J[1], yz)),
            add(times(J[1], sub(dot(b1, ddb3), zx)), times(J[0] - J[2], zx)),
            add(times(J[2], sub(dot(b2, ddb1), xy)), times(J[1] - J[0], xy)))


@compiled
def _enclose(work: Array, mass: float, J: Vector3, mixing: Array) -> None:
    """Compute bounds of the rotor thrusts in each lane [N].

    Args:
        work: models from `_build_models`; receives, from `_BOUNDS_AT` on, least and greatest attained thrust, lower and upper bound.
        mass, J, mixing: from `rotor_thrusts.rotor_model`.
    """
    for lane in range(_LANES):
        yaw = work[36 * _LANES + lane]
        work[_YAW_AT + lane], work[_YAW_AT + _LANES + lane] = sin(yaw), cos(yaw)
    for lane in range(_LANES):
        h, dh, ddh = _heading(_model(work, 9, lane), _model(work, 10, lane), _model(work, 11, lane), work[_YAW_AT + lane],
                              work[_YAW_AT + _LANES + lane])
        defined, thrust, x, y, z = _wrench(_vector_model(work, 0, lane), _vector_model(work, 1, lane), _vector_model(work, 2, lane), h, dh, ddh, mass, J)
        for k in range(4):
            at = _WRENCH_AT + k * _LANES + lane
            work[at], work[at + 4 * _LANES], work[at + 8 * _LANES], work[at + 12 * _LANES] = thrust[k], x[k], y[k], z[k]
        work[_BOUNDS_AT + lane] = np.inf if defined else -np.inf
    for lane in range(_LANES):
        lowest = below = work[_BOUNDS_AT + lane]
        highest = above = -lowest
        for q in range(4):
            rotor = (0.0, 0.0, 0.0, 0.0)
            for k in range(4):
                rotor = add(rotor, times(mixing[q, k], _model(work, _WRENCH_MODEL + k, lane)))
            lowest, highest = min(lowest, rotor[0]), max(highest, rotor[0])
            below, above = min(below, least(rotor)), max(above, greatest(rotor))
        at = _BOUNDS_AT + lane
        work[at], work[at + _LANES], work[at + 2 * _LANES], work[at + 3 * _LANES] = lowest, highest, below, above


@compiled
def prove_rotors(coefficients: Array, yaw: Array, durations: Array, lowest: float, highest: float, low: float, high: float, mass: float,
                 J: Vector3, mixing: Array) -> tuple[bool, float, float]:
    """Prove that each rotor's thrust stays within [low, high], or find a thrust outside.

    Args:
        coefficients, yaw, durations, mass, J, mixing: as for `rotor_thrusts.sample_rotor_thrusts`.
        lowest, highest: attained thrusts, from samples [N].
        low, high: limits [N].

    Returns:
        (holds, lowest, highest): proved bounds of all thrusts [N]. Where a thrust violates the limits or the proof fails, `holds`
        is False, and the others are attained thrusts.
    """
    tight, proved_low, proved_high = _TIGHTNESS * (high - low), lowest, highest
    powers, work = np.empty((12, _POWERS * _LANES)), np.empty(_BOUNDS_AT + 4 * _LANES)
    lane_bounds = work[_BOUNDS_AT:].reshape((4, _LANES))
    rows, length = np.empty((_DEPTH + 2, 12, _POWERS)), np.empty(_DEPTH + 2)
    nodes = 0
    for i in range(len(durations) - 1, -1, -1):  # backwards: the rotors are loaded most at the end
        relative = coefficients[i] - coefficients[i][:, :1]  # exact differences: rounding would grow with the distance from the origin
        rows[0, :9], length[0] = motion(relative, durations[i], _DERIVATIVES[0]), durations[i]
        three_derivatives(yaw[i:i + 1], 0, durations[i], _DERIVATIVES[1], rows[0, 9:])
        top = 1
        while top > 0:
            top -= 1
            nodes += 1
            open_halves = 3  # bit by bit: left, right
            if length[top] <= _DURATION_MAX:
                _build_models(rows[top], powers, work)
                _enclose(work, mass, J, mixing)
                for lane in range(_LANES):
                    if lane_bounds[2, lane] > -np.inf:
                        lowest, highest = min(lowest, lane_bounds[0, lane]), max(highest, lane_bounds[1, lane])
                if lowest < low or highest > high:
                    return False, lowest, highest
                for half in range(2):
                    first, last = half * (_LANES // 2), (half + 1) * (_LANES // 2)
                    below, above = smallest(lane_bounds[2, first:last]) - ROUNDING, largest(lane_bounds[3, first:last]) + ROUNDING
                    if below >= max(low, lowest - tight) and above <= min(high, highest + tight):
                        proved_low, proved_high = min(proved_low, below), max(proved_high, above)
                        open_halves -= 1 + half
            if open_halves == 0:
                continue
            if top >= _DEPTH or nodes >= _NODES:
                return False, lowest, highest
            for n in range(12):
                split(rows[top, n], rows[top + 1, n])
            length[top] = length[top + 1] = 0.5 * length[top]
            if open_halves == 1:
                rows[top] = rows[top + 1]
            top += 2 if open_halves == 3 else 1
    return True, proved_low, proved_high
