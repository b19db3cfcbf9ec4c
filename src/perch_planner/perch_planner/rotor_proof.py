"""A proof that single rotors keep their range on a whole plan. [uses M:eq1, M:eq10, M:eq12, M:eq13, P:eq2]

The rotor thrusts that `rotor_thrusts` samples are no polynomials, but they are made of some: specific force, jerk and snap, yaw and
two derivatives. On an interval each of these is a Taylor model of second order, whose second derivative lies in the hull of its
Bernstein coefficients, and the same formulas in such numbers (`taylor_models`) bound each rotor's thrust and its second derivative.
Where the thrust itself is not bounded closely enough, samples are: between two of them, a distance h apart, a function whose second
derivative lies in [a, b] leaves their hull by at most max(b, 0) h^2 / 8 downwards and max(-a, 0) h^2 / 8 upwards. An interval whose
bounds leave the limits is halved.
"""

from __future__ import annotations

import numpy as np

from perch_core.arrays import Array, Vector3
from perch_core.jit import compiled
from perch_core.vehicle import GRAVITY
from perch_planner.bounds import split, time_derivative
from perch_planner.rotor_thrusts import add_values, bases_at, thrusts_at
from perch_planner.taylor_models import (
    ROUNDING, ZERO, Taylor, Vector, add, axpy, cosine, cross, dot, greatest, inverse_root, least, mul, scale, sine, sub, times, vector_add)

_ORDERS = 5    # of f_x, f_y, f_z and the yaw: the functions themselves and four derivatives
_ROWS = 4 * _ORDERS
_SIZES = np.array([13, 12, 11, 10, 9] * 3 + [15, 14, 13, 12, 11])
_DEPTH = 30
_NODES = 20_000
_SAMPLES = 16    # steps between samples of an interval
_LONGEST = 0.1   # [s] longer intervals are halved at once: their models are wide
_TIGHT = 0.02    # proved bounds lie within this share of the range from what is attained
_SMALLEST = 1e-6  # squared lengths that may be less have no direction
_BASES = bases_at(np.linspace(0.0, 1.0, _SAMPLES + 1))


@compiled
def _rows(coefficients: Array, yaw: Array, duration: float, out: Array) -> None:
    """Bernstein coefficients of the specific force and of the yaw, each with four derivatives, into `out`, shape (20, 15)."""
    for order in range(_ORDERS):
        force, turn = time_derivative(coefficients, 2 + order, duration), time_derivative(yaw.reshape((1, 15)), order, duration)
        for d in range(3):
            for k in range(force.shape[1]):
                out[_ORDERS * d + order, k] = force[d, k]
        for k in range(turn.shape[1]):
            out[3 * _ORDERS + order, k] = turn[0, k]
    for k in range(13):
        out[2 * _ORDERS, k] += GRAVITY


@compiled
def _halve(right: Array, left: Array, half: float, numbers: Array) -> None:
    """Halve the interval of all rows: the left halves into `left`, `right` becomes the other.

    Args:
        right, left: shape (20, 15).
        half: of its length [s].
        numbers: receives the models of the specific force, jerk and snap, by component, and of yaw, rate and acceleration in units
            of `half`, shape (4, 3, 4).
    """
    for row in range(_ROWS):
        split(right[row, :_SIZES[row]], left[row, :_SIZES[row]])
    for d in range(4):
        for k in range(3):
            row = _ORDERS * d + k
            bend = right[row + 2, 0]
            reach = 0.0
            for i in range(_SIZES[row + 2]):
                reach = max(reach, max(abs(left[row + 2, i] - bend), abs(right[row + 2, i] - bend)))
            numbers[d, k, 0], numbers[d, k, 1] = right[row, 0], half * right[row + 1, 0]
            numbers[d, k, 2], numbers[d, k, 3] = half * half * bend, half * half * reach


@compiled
def _number(numbers: Array, d: int, k: int) -> Taylor:
    return numbers[d, k, 0], numbers[d, k, 1], numbers[d, k, 2], numbers[d, k, 3]


@compiled
def _direction(f: Vector, df: Vector, ddf: Vector, k: Taylor) -> tuple[Vector, Vector, Vector]:
    """As `flatness.direction_derivatives`, with k = 1 / |f|."""
    u = scale(k, f)
    dn = dot(u, df)
    du = scale(k, axpy(times(-1.0, dn), u, df))
    ddn = add(dot(du, df), dot(u, ddf))
    return u, du, scale(k, axpy(times(-2.0, dn), du, axpy(times(-1.0, ddn), u, ddf)))


@compiled
def _heading(yaw: Taylor, rate: Taylor, acceleration: Taylor) -> tuple[Vector, Vector, Vector]:
    """As `flatness.heading_derivatives`."""
    s, c, squared = sine(yaw), cosine(yaw), mul(rate, rate)
    return ((times(-1.0, s), c, ZERO), (times(-1.0, mul(c, rate)), times(-1.0, mul(s, rate)), ZERO),
            (sub(mul(s, squared), mul(c, acceleration)), times(-1.0, add(mul(c, squared), mul(s, acceleration))), ZERO))


@compiled
def rotor_models(numbers: Array, mass: float, J: Vector3, mixing: Array, out: Array) -> bool:
    """Models of the four rotor thrusts [N], into `out`, shape (4, 4); False where thrust or heading may vanish.

    Args:
        numbers: of the specific force, jerk and snap by component, and of yaw, rate and acceleration, shape (4, 3, 4).
        mass, J, mixing: of `rotor_thrusts.rotor_model`.
    """
    f = _number(numbers, 0, 0), _number(numbers, 1, 0), _number(numbers, 2, 0)
    df = _number(numbers, 0, 1), _number(numbers, 1, 1), _number(numbers, 2, 1)
    ddf = _number(numbers, 0, 2), _number(numbers, 1, 2), _number(numbers, 2, 2)
    squared = dot(f, f)
    if least(squared) <= _SMALLEST:
        return False
    inverse = inverse_root(squared)
    b3, db3, ddb3 = _direction(f, df, ddf, inverse)
    h, dh, ddh = _heading(_number(numbers, 3, 0), _number(numbers, 3, 1), _number(numbers, 3, 2))
    n, twist = cross(h, b3), cross(dh, db3)
    dn = vector_add(cross(dh, b3), cross(h, db3))
    ddn = vector_add(vector_add(cross(ddh, b3), cross(h, ddb3)), vector_add(twist, twist))
    across = dot(n, n)
    if least(across) <= _SMALLEST:
        return False
    b1, db1, ddb1 = _direction(n, dn, ddn, inverse_root(across))
    b2 = cross(b3, b1)
    wx, wy, wz = times(-1.0, dot(b2, db3)), dot(b1, db3), dot(b2, db1)
    xy, yz, zx = mul(wx, wy), mul(wy, wz), mul(wz, wx)
    moment_x = add(times(J[0], sub(yz, dot(b2, ddb3))), times(J[2] - J[1], yz))
    moment_y = add(times(J[1], sub(dot(b1, ddb3), zx)), times(J[0] - J[2], zx))
    moment_z = add(times(J[2], sub(dot(b2, ddb1), xy)), times(J[1] - J[0], xy))
    thrust = times(mass, mul(squared, inverse))
    for q in range(4):
        rotor = add(add(times(mixing[q, 0], thrust), times(mixing[q, 1], moment_x)),
                    add(times(mixing[q, 2], moment_y), times(mixing[q, 3], moment_z)))
        out[q, 0], out[q, 1], out[q, 2], out[q, 3] = rotor
    return True


@compiled
def _sampled(rows: Array, mass: float, J: Vector3, mixing: Array) -> tuple[float, float]:
    """Least and greatest thrust of a rotor [N] among the samples of an interval; rows: of `_rows`, of the interval."""
    x = np.zeros((12, _SAMPLES + 1))
    for d in range(4):
        for order in range(3):
            row = _ORDERS * d + order
            add_values(rows[row, :_SIZES[row]], _BASES[_SIZES[row] - 11], x[3 * order + d if d < 3 else 9 + order])
    lowest, highest = np.inf, -np.inf
    for k in range(_SAMPLES + 1):
        p, q, r, s = thrusts_at(x, k, mass, J, mixing)
        lowest, highest = min(lowest, min(min(p, q), min(r, s))), max(highest, max(max(p, q), max(r, s)))
    return lowest, highest


@compiled
def prove_rotors(coefficients: Array, yaw: Array, durations: Array, lowest: float, highest: float, low: float, high: float, mass: float,
                 J: Vector3, mixing: Array) -> tuple[bool, float, float]:
    """Prove that each rotor's thrust stays within [low, high], or find where it does not.

    Args:
        coefficients, yaw, durations, mass, J, mixing: as for `rotor_thrusts.sampled`.
        lowest, highest: thrusts that are attained [N].
        low, high: limits [N].

    Returns:
        (holds, lowest, highest): proved bounds of all thrusts [N]. Where a thrust beyond the limits was found, or nothing could be
        proved, `holds` is False, and the others are thrusts that are attained.
    """
    tight, proved_low, proved_high = _TIGHT * (high - low), lowest, highest
    numbers, rotors = np.empty((4, 3, 4)), np.empty((4, 4))
    rows, length, whole = np.empty((_DEPTH + 2, _ROWS, 15)), np.empty(_DEPTH + 2), np.empty((_ROWS, 15))
    nodes = 0
    for i in range(len(durations) - 1, -1, -1):  # backwards: the end asks most of the rotors
        _rows(coefficients[i], yaw[i], durations[i], rows[0])
        length[0] = durations[i]
        top = 1
        while top > 0:
            top -= 1
            nodes += 1
            half = 0.5 * length[top]
            if length[top] <= _LONGEST:
                whole[:] = rows[top]
            _halve(rows[top], rows[top + 1], half, numbers)
            if length[top] <= _LONGEST and rotor_models(numbers, mass, J, mixing, rotors):
                below, above, drop, lift = np.inf, -np.inf, 0.0, 0.0
                for q in range(4):
                    rotor = rotors[q, 0], rotors[q, 1], rotors[q, 2], rotors[q, 3]
                    lowest, highest = min(lowest, rotor[0]), max(highest, rotor[0])
                    below, above = min(below, least(rotor)), max(above, greatest(rotor))
                    drop, lift = max(drop, rotor[2] + rotor[3]), max(lift, rotor[3] - rotor[2])
                drop, lift = drop / (2 * _SAMPLES**2), lift / (2 * _SAMPLES**2)
                if max(drop, lift) < tight and not (below > max(low, lowest - tight) and above < min(high, highest + tight)):
                    at_least, at_most = _sampled(whole, mass, J, mixing)
                    lowest, highest = min(lowest, at_least), max(highest, at_most)
                    below, above = max(below, at_least - drop), min(above, at_most + lift)
                if lowest < low or highest > high:
                    return False, lowest, highest
                below, above = below - ROUNDING, above + ROUNDING
                if below >= max(low, lowest - tight) and above <= min(high, highest + tight):
                    proved_low, proved_high = min(proved_low, below), max(proved_high, above)
                    continue
            if top >= _DEPTH or nodes >= _NODES:
                return False, lowest, highest
            length[top] = length[top + 1] = half
            top += 2
    return True, proved_low, proved_high
