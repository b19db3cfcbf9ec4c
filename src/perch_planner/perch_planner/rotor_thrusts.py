"""Thrusts of the single rotors along a plan, violations of their range, and linear bounds against these.

A collective thrust within its range [M:eq16] does not suffice: rotation requires moments, and near contact, where the thrust
is low, the rotors have little reserve for them. From the flat outputs, flatness gives thrust, body rates and angular
accelerations [M:eq9-13], and with Euler's equation [M:eq1] and the allocation [P:eq2]

    f = A^-1 (m |f|, J w' + w x J w).

This f is not polynomial. It is sampled, and its extrema are refined by parabolas through the samples; `rotor_proof` proves them.
It is smooth in acceleration, jerk and snap: its linearisation at the present plan bounds the next plan.
"""

from __future__ import annotations

from functools import lru_cache
from math import cos, perm, pi, sin

import numpy as np

from perch_core import bernstein
from perch_core.arrays import Array, Indices, Vector3, vector3
from perch_core.flatness import commanded_frame, turned_heading
from perch_core.jit import compiled
from perch_core.vector3 import axpy, cross, norm, times
from perch_core.vehicle import GRAVITY, Vehicle
from perch_planner.reduced_qp import ProgramArrays
from perch_planner.reduced_rows import Rows, normalise, whitened
from perch_planner.reference_element import DEGREE, FUNCTIONS, TABLES

_COUNT = 49
_PLACES = 0.5 - 0.5 * np.cos(np.pi * np.arange(_COUNT) / (_COUNT - 1))  # dense at the ends, where polynomials turn fastest
_FREE_FALL = 1e-3        # [m/s^2] below this specific thrust no attitude and so no moment is defined
_NO_THRUST = -1e3        # [N] in its place
_PARALLEL_SINE = 1e-6    # sine of the angle between thrust and b2_des below which yaw defines no attitude
_DIFFERENCE_STEPS = (1e-4, 1e-3, 1e-2)  # of acceleration, jerk and snap in the linearisation
_NEAR = 0.1              # rotors this near to a limit are bounded; share of the range
_INSET_SHARE = 2e-3      # bounds are set inside by this share of the range,
_OVERSHOOT_FACTOR = 1.5  # and by this multiple of the overshoot between the places


RotorModel = tuple[float, Vector3, Array]
"""Mass [kg], principal inertias [kg m^2], wrench to rotor thrusts, shape (4, 4)."""

Rotors = tuple[float, float, float, Vector3, Array]
"""Limits of a rotor's thrust [N], and the entries of `RotorModel`."""


def rotor_model(vehicle: Vehicle) -> RotorModel:
    """Return the parameters of a vehicle for the kernels."""
    return vehicle.mass, vector3(vehicle.inertia), _inverse(tuple(vehicle.allocation.ravel().tolist()))


@lru_cache(maxsize=16)
def _inverse(entries: tuple[float, ...]) -> Array:
    """Inverse of a 4 x 4 matrix, cached, as all plans of a vehicle use the same."""
    return np.ascontiguousarray(np.linalg.inv(np.reshape(entries, (4, 4))))


def bases_at(places: Array) -> tuple[Array, Array]:
    """Maps from Bernstein coefficients to the derivatives 2 to 4 and 0 to 2 at places in [0, 1], shapes (15, 3 places)."""
    rows = [perm(14, n) * np.diff(np.eye(15), n) @ bernstein.basis(14 - n, places).T for n in range(5)]
    return np.hstack(rows[2:]), np.hstack(rows[:3])


_MOTION_BASIS, _HEADING_BASIS = bases_at(_PLACES)
_FUNCTIONS_AT = np.vstack([bernstein.basis(DEGREE - n, _PLACES) @ TABLES[n, :DEGREE + 1 - n] for n in range(2, 5)])
"""Second to fourth derivative of the functions of the reference element at the places, shape (3 places, 15)."""


@compiled
def three_derivatives(coefficients: Array, order: int, duration: float, basis: Array, out: Array) -> None:
    """Compute derivatives of three successive orders from `order` on, by order, then by polynomial.

    Args:
        coefficients: Bernstein coefficients, shape (r, 15).
        order: lowest order.
        duration: of the segment [s].
        basis: from `bases_at`, shape (15, 3 places).
        out: receives the values, shape (3 r, places).
    """
    r, count = len(coefficients), out.shape[1]
    for n in range(3):
        unit, at = duration ** -(order + n), n * count
        for d in range(r):
            for k in range(count):
                out[n * r + d, k] = 0.0
            for i in range(0, 15, 5):  # five at a time: each sum is loaded and stored a fifth as often
                p, q, s, t, u = (unit * coefficients[d, i], unit * coefficients[d, i + 1], unit * coefficients[d, i + 2],
                                 unit * coefficients[d, i + 3], unit * coefficients[d, i + 4])
                for k in range(count):
                    out[n * r + d, k] = (out[n * r + d, k] + p * basis[i, at + k] + q * basis[i + 1, at + k] + s * basis[i + 2, at + k]
                                         + t * basis[i + 3, at + k] + u * basis[i + 4, at + k])


@compiled
def motion(coefficients: Array, duration: float, basis: Array) -> Array:
    """Specific force, jerk and snap of a segment, shape (9, places); basis: the first of `bases_at`."""
    out = np.empty((9, basis.shape[1] // 3))
    three_derivatives(coefficients, 2, duration, basis, out)
    for k in range(out.shape[1]):
        out[2, k] += GRAVITY
    return out


@compiled
def headings(yaw: Array, duration: float, basis: Array) -> Array:
    """x and y of b2_des and of its first two derivatives on a segment, shape (6, places). [M:eq12]

    Args:
        yaw: Bernstein coefficients of the heading, shape (1, 15) [rad].
        duration: of the segment [s].
        basis: the second of `bases_at`.
    """
    count = basis.shape[1] // 3
    turn, out = np.empty((3, count)), np.empty((6, count))
    three_derivatives(yaw, 0, duration, basis, turn)
    for k in range(count):
        h, dh, ddh = turned_heading(sin(turn[0, k]), cos(turn[0, k]), turn[1, k], turn[2, k])
        out[0, k], out[1, k], out[2, k], out[3, k], out[4, k], out[5, k] = h[0], h[1], dh[0], dh[1], ddh[0], ddh[1]
    return out


@compiled
def plan_headings(yaw: Array, durations: Array) -> Array:
    """`headings` of each segment at the places where rotors may be bounded, shape (f, 6, 49); yaw: shape (f, 15) [rad]."""
    out = np.empty((len(durations), 6, _COUNT))
    for i in range(len(durations)):
        out[i] = headings(yaw[i:i + 1], durations[i], _HEADING_BASIS)
    return out


@compiled
def thrusts_along(x: Array, heading: Array, mass: float, J: Vector3, mixing: Array, out: Array) -> None:
    """Write rotor thrusts [N] at each place of `motion` and `headings` to `out`, shape (4, places).

    Where no attitude is defined, the collective thrust is -1000 N. The first loop has no branches, so that it is vectorised.
    """
    count = x.shape[1]
    for k in range(count):
        falls = norm((x[0, k], x[1, k], x[2, k])) < _FREE_FALL
        f = (x[0, k], x[1, k], 1.0 if falls else x[2, k])
        h, dh, ddh = (heading[0, k], heading[1, k], 0.0), (heading[2, k], heading[3, k], 0.0), (heading[4, k], heading[5, k], 0.0)
        specific = norm(f)
        _, _, _, w, dw = commanded_frame(f, (x[3, k], x[4, k], x[5, k]), (x[6, k], x[7, k], x[8, k]), h, dh, ddh)
        M = axpy(1.0, times(J, dw), cross(w, times(J, w)))
        undefined = falls | (norm(cross(h, f)) < _PARALLEL_SINE * specific)
        out[0, k] = _NO_THRUST if undefined else mass * specific
        for d in range(3):
            out[1 + d, k] = 0.0 if undefined else M[d]
    for k in range(count):
        T, x_x, y_y, z_z = out[0, k], out[1, k], out[2, k], out[3, k]
        for q in range(4):
            out[q, k] = mixing[q, 0] * T + mixing[q, 1] * x_x + mixing[q, 2] * y_y + mixing[q, 3] * z_z


@compiled
def _vertex(values: Array, k: int, sign: float) -> tuple[float, float]:
    """Index, with fractions, and value of the extremum of the parabola through sample k and its neighbours.

    The parabola is a function of the sample's index, of which the places are a smooth function: see `_place`.
    """
    last = len(values) - 1
    middle = min(max(k, 1), last - 1)
    before, here, after = values[middle - 1], values[middle], values[middle + 1]
    bend = before - 2.0 * here + after
    shift = 0.5 * (before - after) / bend if sign * bend < 0.0 else 2.0
    if abs(shift) > 1.0:
        return float(k), values[k]
    return middle + shift, here - 0.25 * (before - after) * shift


@compiled
def _place(at: float) -> float:
    """Place in [0, 1] of a sample's index, with fractions."""
    return 0.5 - 0.5 * cos(pi * at / (_COUNT - 1))


@compiled
def sample_rotor_thrusts(coefficients: Array, heading: Array, durations: Array, mass: float, J: Vector3, mixing: Array) -> tuple[Array, Array, Array]:
    """Motion and rotor thrusts of a plan on the places of each segment that may be bounded, and their extrema.

    Args:
        coefficients: Bernstein coefficients of the position, shape (f, 3, 15) [m].
        heading: from `plan_headings`.
        durations: shape (f,) [s].
        mass, J, mixing: from `rotor_model`.

    Returns:
        (motions, thrusts, row): `motion` of each segment, shape (f, 9, 49); thrusts, shape (f, 4, 49) [N]; row: least and its time,
        greatest and its time, refined between the samples, shape (4,) [N, s].
    """
    motions, thrusts = np.empty((len(durations), 9, _COUNT)), np.empty((len(durations), 4, _COUNT))
    row = np.array([np.inf, 0.0, -np.inf, 0.0])
    begin = 0.0
    for i in range(len(durations)):
        T = durations[i]
        motions[i] = motion(coefficients[i], T, _MOTION_BASIS)
        thrusts_along(motions[i], heading[i], mass, J, mixing, thrusts[i])
        for q in range(4):
            at, value = _vertex(thrusts[i, q], thrusts[i, q].argmin(), -1.0)
            if value < row[0]:
                row[0], row[1] = value, begin + _place(at) * T
            at, value = _vertex(thrusts[i, q], thrusts[i, q].argmax(), 1.0)
            if value > row[2]:
                row[2], row[3] = value, begin + _place(at) * T
        begin += T
    return motions, thrusts, row


@compiled
def _slopes(x: Array, heading: Array, mass: float, J: Vector3, mixing: Array, thrusts: Array) -> Array:
    """Derivatives of the rotor thrusts with respect to specific force, jerk and snap, shape (9, 4, places)."""
    out = np.empty((9, 4, x.shape[1]))
    for e in range(9):
        step = _DIFFERENCE_STEPS[e // 3]
        x[e] += step
        thrusts_along(x, heading, mass, J, mixing, out[e])
        x[e] -= step
        for q in range(4):
            for k in range(x.shape[1]):
                out[e, q, k] = (out[e, q, k] - thrusts[q, k]) / step
    return out


@compiled
def _functions(program: ProgramArrays, segment: int, at: Indices) -> Array:
    """Acceleration, jerk and snap at some places of a segment, as factors of w of one dimension and constants of all three.

    Args:
        program: of `reduced_qp.assemble`.
        segment: its index.
        at: indices of the places, shape (n,).

    Returns:
        Shape (3 n, size + 3), by derivative, then by place.
    """
    duration, n = program[0][segment], len(at)
    rows = np.empty((3 * n, FUNCTIONS))
    for order in range(3):
        unit = duration ** -(order + 2)
        for k in range(n):
            for c in range(FUNCTIONS):
                rows[order * n + k, c] = unit * _FUNCTIONS_AT[order * _COUNT + at[k], c]
    out: Array = np.dot(rows, whitened(program, segment))
    return out


@compiled
def rotor_rows(program: ProgramArrays, motions: Array, thrusts: Array, row: Array, heading: Array, low: float, high: float, mass: float, J: Vector3,
               mixing: Array) -> tuple[Indices, Rows]:
    """Linearised bounds on the rotors that leave [low, high] or are near to it.

    Args:
        program: of `reduced_qp.assemble`.
        motions, thrusts, row: from `sample_rotor_thrusts`; extrema between the places tighten the bounds at the places.
        heading, mass, J, mixing: as for `sample_rotor_thrusts`.
        low, high: limits of a rotor's thrust [N].

    Returns:
        (keys, rows): for each rotor and place near a limit, an ascending key of segment, place and rotor, and a row of w.
    """
    durations, m = program[0], len(program[3])
    near, inset = _NEAR * (high - low), _INSET_SHARE * (high - low)
    above = low + inset + _OVERSHOOT_FACTOR * max(thrusts.min() - row[0], 0.0)
    below = high - inset - _OVERSHOOT_FACTOR * max(row[2] - thrusts.max(), 0.0)
    chosen = (thrusts < low + near) | (thrusts > high - near)
    chosen[1:, :, 0] = False  # the end of the segment before
    count = chosen.sum()
    keys, rows = np.empty(count, np.int64), np.empty((count, 3 * m))
    lower, upper = np.full(count, -np.inf), np.full(count, np.inf)
    r = 0
    for i in range(len(durations)):
        at = np.nonzero(chosen[i, 0] | chosen[i, 1] | chosen[i, 2] | chosen[i, 3])[0]
        n = len(at)
        if n == 0:
            continue
        x = motions[i][:, at]
        slopes = _slopes(x, heading[i][:, at], mass, J, mixing, thrusts[i][:, at])
        values = _functions(program, i, at)
        for k in range(n):
            for q in range(4):
                if not chosen[i, q, at[k]]:
                    continue
                constant = -thrusts[i, q, at[k]] - slopes[2, q, k] * GRAVITY  # the program has the acceleration, without gravity
                for d in range(3):
                    a, j, s = slopes[d, q, k], slopes[3 + d, q, k], slopes[6 + d, q, k]
                    constant += (a * (x[d, k] - values[k, m + d]) + j * (x[3 + d, k] - values[n + k, m + d])
                                 + s * (x[6 + d, k] - values[2 * n + k, m + d]))
                    for c in range(m):
                        rows[r, d * m + c] = a * values[k, c] + j * values[n + k, c] + s * values[2 * n + k, c]
                if thrusts[i, q, at[k]] < low + near:
                    lower[r] = above + constant
                else:
                    upper[r] = below + constant
                keys[r] = (i * _COUNT + at[k]) * 4 + q
                r += 1
    normalise(rows, lower, upper)
    return keys, (rows, lower, upper)
