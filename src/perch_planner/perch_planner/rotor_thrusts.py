"""Thrusts of the single rotors that a plan asks for: where they leave their range, and linear bounds against it.

Collective thrust within its range [M:eq16] does not suffice: turning takes moments, and near contact, where the thrust is
low, the rotors have little left for them. From the flat outputs, flatness gives thrust, body rates and angular
accelerations [M:eq9-13], and with Euler's equation [M:eq1] and the allocation [P:eq2]

    f = A^-1 (m |f|, J w' + w x J w).

That is no polynomial, so it is sampled, the extrema refined by parabolas through the samples; `rotor_proof` proves what they promise.
It is smooth in acceleration, jerk and snap: its linearisation at the present plan bounds the next one.
"""

from __future__ import annotations

from functools import lru_cache
from math import cos, perm, sin

import numpy as np

from perch_core import bernstein
from perch_core.arrays import Array, Indices, Vector3, vector3
from perch_core.flatness import commanded_frame, turned_heading
from perch_core.jit import compiled
from perch_core.vector3 import axpy, cross, norm, times
from perch_core.vehicle import GRAVITY, Vehicle
from perch_planner.reduced_qp import ProgramArrays
from perch_planner.reduced_rows import Rows, normalise, whitened
from perch_planner.reference_element import DEGREE, TABLES

_COUNT = 49
_FINER = 4  # samples from one place to the next, where a segment's thrusts come near a limit
_SAMPLES = 0.5 - 0.5 * np.cos(np.pi * np.arange(_FINER * (_COUNT - 1) + 1) / (_FINER * (_COUNT - 1)))
_PLACES = _SAMPLES[::_FINER].copy()  # where a rotor is bounded; dense at the ends, where polynomials turn fastest
_FREE_FALL = 1e-3   # [m/s^2] below this specific thrust no attitude and so no moment is defined
_NO_THRUST = -1e3   # [N] in its place
_ALONG = 1e-6       # sine of the angle between thrust and b2_des below which yaw defines no attitude
_STEPS = (1e-4, 1e-3, 1e-2)  # of acceleration, jerk and snap in the linearisation
_NEAR = 0.1         # rotors this near to a limit are bounded; share of the range
_KEEP = 2e-3        # bounds are set inside by this share of the range,
_BETWEEN = 1.5      # and by this multiple of what was seen between the places


RotorModel = tuple[float, Vector3, Array]
"""Mass [kg], principal inertias [kg m^2], wrench to rotor thrusts, shape (4, 4)."""


def rotor_model(vehicle: Vehicle) -> RotorModel:
    """What the kernels need of a vehicle."""
    return vehicle.mass, vector3(vehicle.inertia), _inverse(tuple(vehicle.allocation.ravel().tolist()))


@lru_cache(maxsize=16)
def _inverse(entries: tuple[float, ...]) -> Array:
    """Inverse of a matrix of four rows: every plan of a vehicle takes the same."""
    return np.ascontiguousarray(np.linalg.inv(np.reshape(entries, (4, 4))))


def bases_at(places: Array) -> tuple[Array, Array]:
    """From Bernstein coefficients to values at places in [0, 1]: second to fourth, and zeroth to second derivative, shapes (15, 3 places)."""
    rows = [perm(14, n) * np.diff(np.eye(15), n) @ bernstein.basis(14 - n, places).T for n in range(5)]
    return np.hstack(rows[2:]), np.hstack(rows[:3])


_BASES, _FINE_BASES = bases_at(_PLACES), bases_at(_SAMPLES)
_FUNCTIONS_AT = np.vstack([bernstein.basis(DEGREE - n, _PLACES) @ TABLES[n, :DEGREE + 1 - n] for n in range(2, 5)])
"""Second to fourth derivative of the functions of the reference element at the places, shape (3 places, 15)."""


@compiled
def motion(coefficients: Array, yaw: Array, duration: float, bases: tuple[Array, Array]) -> Array:
    """Specific force, jerk and snap, yaw and its first two derivatives at the places of `bases_at`, shape (12, places)."""
    moved, turned = np.dot(coefficients, bases[0]), np.dot(yaw, bases[1])
    count = len(turned) // 3
    out = np.empty((12, count))
    for n in range(3):
        unit, slow = duration**-(n + 2), duration**-n
        for d in range(3):
            for k in range(count):
                out[3 * n + d, k] = unit * moved[d, n * count + k]
        for k in range(count):
            out[9 + n, k] = slow * turned[n * count + k]
    for k in range(count):
        out[2, k] += GRAVITY
    return out


@compiled
def thrusts_along(x: Array, mass: float, J: Vector3, mixing: Array, out: Array) -> None:
    """Rotor thrusts [N] at each place of `motion`, into `out`, shape (4, places); -1000 N in all where no attitude is defined.

    The second loop has no branches: compiled, it takes several places at a time.
    """
    count = x.shape[1]
    turn = np.empty((2, count))
    for k in range(count):
        turn[0, k], turn[1, k] = sin(x[9, k]), cos(x[9, k])
    for k in range(count):
        falls = norm((x[0, k], x[1, k], x[2, k])) < _FREE_FALL
        f = (x[0, k], x[1, k], 1.0 if falls else x[2, k])
        h, dh, ddh = turned_heading(turn[0, k], turn[1, k], x[10, k], x[11, k])
        specific = norm(f)
        _, _, _, w, dw = commanded_frame(f, (x[3, k], x[4, k], x[5, k]), (x[6, k], x[7, k], x[8, k]), h, dh, ddh)
        M = axpy(1.0, times(J, dw), cross(w, times(J, w)))
        undefined = falls | (norm(cross(h, f)) < _ALONG * specific)
        out[0, k] = _NO_THRUST if undefined else mass * specific
        for d in range(3):
            out[1 + d, k] = 0.0 if undefined else M[d]
    for k in range(count):
        T, x_x, y_y, z_z = out[0, k], out[1, k], out[2, k], out[3, k]
        for q in range(4):
            out[q, k] = mixing[q, 0] * T + mixing[q, 1] * x_x + mixing[q, 2] * y_y + mixing[q, 3] * z_z


@compiled
def _vertex(values: Array, k: int, sign: float) -> tuple[float, float]:
    """Place near sample k where the parabola through it and its neighbours is extreme, and that value.

    The parabola runs over the samples' numbers, in which their places are smooth.
    """
    last = len(values) - 1
    middle = min(max(k, 1), last - 1)
    before, here, after = values[middle - 1], values[middle], values[middle + 1]
    bend = before - 2.0 * here + after
    shift = 0.5 * (before - after) / bend if sign * bend < 0.0 else 2.0
    if abs(shift) > 1.0:
        return 0.5 - 0.5 * np.cos(np.pi * k / last), values[k]
    return 0.5 - 0.5 * np.cos(np.pi * (middle + shift) / last), here - 0.25 * (before - after) * shift


@compiled
def _segment(coefficients: Array, yaw: Array, duration: float, bases: tuple[Array, Array], mass: float, J: Vector3, mixing: Array) -> Array:
    """Rotor thrusts of a segment at the places of `bases_at`, shape (4, places) [N]."""
    x = motion(coefficients, yaw, duration, bases)
    out = np.empty((4, x.shape[1]))
    thrusts_along(x, mass, J, mixing, out)
    return out


@compiled
def sampled(coefficients: Array, yaw: Array, durations: Array, low: float, high: float, mass: float, J: Vector3, mixing: Array
            ) -> tuple[Array, Array]:
    """Rotor thrusts of a plan on the places of each segment that may be bounded, and their extrema.

    Args:
        coefficients: Bernstein coefficients of the position, shape (f, 3, 15) [m].
        yaw: of the heading, shape (f, 15) [rad].
        durations: shape (f,) [s].
        low, high: limits of a rotor's thrust [N]; segments that come near them are sampled more finely.
        mass, J, mixing: of `rotor_model`.

    Returns:
        (thrusts, row): thrusts, shape (f, 4, 49) [N]; row: least and its time, greatest and its time, refined between
        the samples, shape (4,) [N, s].
    """
    f, near = len(durations), _NEAR * (high - low)
    out, row = np.empty((f, 4, _COUNT)), np.array([np.inf, 0.0, -np.inf, 0.0])
    begin = 0.0
    for i in range(f):
        T = durations[i]
        found = _segment(coefficients[i], yaw[i], T, _BASES, mass, J, mixing)
        out[i] = found
        if found.min() < low + near or found.max() > high - near:
            found = _segment(coefficients[i], yaw[i], T, _FINE_BASES, mass, J, mixing)
        for q in range(4):
            place, value = _vertex(found[q], found[q].argmin(), -1.0)
            if value < row[0]:
                row[0], row[1] = value, begin + place * T
            place, value = _vertex(found[q], found[q].argmax(), 1.0)
            if value > row[2]:
                row[2], row[3] = value, begin + place * T
        begin += T
    return out, row


@compiled
def _slopes(x: Array, mass: float, J: Vector3, mixing: Array, thrusts: Array) -> Array:
    """Derivatives of the rotor thrusts with respect to specific force, jerk and snap, shape (9, 4, places)."""
    out = np.empty((9, 4, x.shape[1]))
    for e in range(9):
        step = _STEPS[e // 3]
        x[e] += step
        thrusts_along(x, mass, J, mixing, out[e])
        x[e] -= step
        for q in range(4):
            for k in range(x.shape[1]):
                out[e, q, k] = (out[e, q, k] - thrusts[q, k]) / step
    return out


@compiled
def rotor_rows(program: ProgramArrays, thrusts: Array, row: Array, coefficients: Array, yaw: Array, low: float, high: float, mass: float,
               J: Vector3, mixing: Array) -> tuple[Indices, Rows]:
    """Linearised bounds on the rotors that leave [low, high] or are near to it.

    Args:
        program: fields of `ReducedProgram`.
        thrusts, row: of `sampled`; what lies beyond the limits between the places is made up for at the places.
        coefficients, yaw, mass, J, mixing: as for `sampled`.
        low, high: limits of a rotor's thrust [N].

    Returns:
        (keys, rows): for each rotor and place near a limit an ascending number that names segment, place and rotor, and a row of w.
    """
    durations, first, unit, spread, centre = program
    near, keep, m = _NEAR * (high - low), _KEEP * (high - low), len(spread)
    above = low + keep + _BETWEEN * max(thrusts.min() - row[0], 0.0)
    below = high - keep - _BETWEEN * max(row[2] - thrusts.max(), 0.0)
    chosen = (thrusts < low + near) | (thrusts > high - near)
    count = chosen.sum()
    keys, rows = np.empty(count, np.int64), np.zeros((count, 3 * m))
    lower, upper = np.full(count, -np.inf), np.full(count, np.inf)
    r = 0
    for i in range(len(durations)):
        if not chosen[i].any():
            continue
        x = motion(coefficients[i], yaw[i], durations[i], _BASES)
        slopes = _slopes(x, mass, J, mixing, thrusts[i])
        values = np.dot(_FUNCTIONS_AT, whitened(program, i))
        for k in range(_COUNT):
            for q in range(4):
                if not chosen[i, q, k]:
                    continue
                known = -thrusts[i, q, k]
                for n in range(3):
                    at, part = n * _COUNT + k, durations[i] ** -(n + 2)
                    for d in range(3):
                        slope = slopes[3 * n + d, q, k]
                        known += slope * (x[3 * n + d, k] - part * values[at, m + d])
                        for c in range(m):
                            rows[r, d * m + c] += slope * part * values[at, c]
                    if n == 0:
                        known -= slopes[2, q, k] * GRAVITY  # the program knows the acceleration
                if thrusts[i, q, k] < low + near:
                    lower[r] = above + known
                else:
                    upper[r] = below + known
                keys[r] = (i * _COUNT + k) * 4 + q
                r += 1
    normalise(rows, lower, upper)
    return keys, (rows, lower, upper)
