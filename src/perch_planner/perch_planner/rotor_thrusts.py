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

import numpy as np

from perch_core import bernstein
from perch_core.arrays import Array, Indices, Vector3, vector3
from perch_core.flatness import commanded_frame, heading_derivatives
from perch_core.jit import compiled
from perch_core.vector3 import axpy, cross, norm, times
from perch_core.vehicle import GRAVITY, Vehicle
from perch_planner.bounds import time_derivative
from perch_planner.linear_bounds import BoundArrays

_COUNT = 49
_FINER = 4  # samples from one place to the next, where a segment's thrusts come near a limit
_SAMPLES = 0.5 - 0.5 * np.cos(np.pi * np.arange(_FINER * (_COUNT - 1) + 1) / (_FINER * (_COUNT - 1)))
_PLACES = _SAMPLES[::_FINER].copy()  # where a rotor is bounded; dense at the ends, where polynomials turn fastest
_FREE_FALL = 1e-3   # [m/s^2] below this specific thrust no attitude and so no moment is defined
_ALONG = 1e-6       # sine of the angle between thrust and b2_des below which yaw defines no attitude
_STEPS = (1e-4, 1e-3, 1e-2)  # of acceleration, jerk and snap in the linearisation
_NEAR = 0.1         # rotors this near to a limit are bounded; share of the range
_KEEP = 2e-3        # bounds are set inside by this share of the range,
_BETWEEN = 1.5      # and by this multiple of what was seen between the places


Four = tuple[float, float, float, float]
"""A number for each rotor."""
RotorModel = tuple[float, Vector3, Array]
"""Mass [kg], principal inertias [kg m^2], wrench to rotor thrusts, shape (4, 4)."""


def rotor_model(vehicle: Vehicle) -> RotorModel:
    """What the kernels need of a vehicle."""
    return vehicle.mass, vector3(vehicle.inertia), _inverse(tuple(vehicle.allocation.ravel().tolist()))


@lru_cache(maxsize=16)
def _inverse(entries: tuple[float, ...]) -> Array:
    """Inverse of a matrix of four rows: every plan of a vehicle takes the same."""
    return np.ascontiguousarray(np.linalg.inv(np.reshape(entries, (4, 4))))


@compiled
def thrusts_of(f: Vector3, j: Vector3, s: Vector3, heading: Vector3, mass: float, J: Vector3, mixing: Array) -> Four:
    """Rotor thrusts [N] of the specific force f, jerk and snap (3 floats each) and yaw with two derivatives; 4 floats."""
    specific = norm(f)
    h, dh, ddh = heading_derivatives(heading[0], heading[1], heading[2])
    if specific < _FREE_FALL or norm(cross(h, f)) < _ALONG * specific:
        return -1e3, -1e3, -1e3, -1e3
    _, _, _, w, dw = commanded_frame(f, j, s, h, dh, ddh)
    M = axpy(1.0, times(J, dw), cross(w, times(J, w)))
    T = mass * specific
    return (mixing[0, 0] * T + mixing[0, 1] * M[0] + mixing[0, 2] * M[1] + mixing[0, 3] * M[2],
            mixing[1, 0] * T + mixing[1, 1] * M[0] + mixing[1, 2] * M[1] + mixing[1, 3] * M[2],
            mixing[2, 0] * T + mixing[2, 1] * M[0] + mixing[2, 2] * M[1] + mixing[2, 3] * M[2],
            mixing[3, 0] * T + mixing[3, 1] * M[0] + mixing[3, 2] * M[1] + mixing[3, 3] * M[2])


def bases_at(places: Array) -> tuple[Array, ...]:
    """Bernstein bases of degree 10 to 14 at places in [0, 1], each of shape (degree + 1, places)."""
    return tuple(bernstein.basis(n, places).T.copy() for n in range(10, 15))


_BASES, _FINE_BASES = bases_at(_PLACES), bases_at(_SAMPLES)


@compiled
def add_values(row: Array, basis: Array, out: Array) -> None:
    """Add the values of a polynomial, given by Bernstein coefficients, at the places of a basis."""
    for i in range(len(row)):
        for k in range(basis.shape[1]):
            out[k] += row[i] * basis[i, k]


@compiled
def motion(coefficients: Array, yaw: Array, duration: float, bases: tuple[Array, ...]) -> Array:
    """Specific force, jerk and snap, yaw and its first two derivatives at the places of `bases_at`, shape (12, places)."""
    out = np.zeros((12, bases[0].shape[1]))
    for order in range(3):
        rows, turn = time_derivative(coefficients, order + 2, duration), time_derivative(yaw.reshape((1, 15)), order, duration)
        for d in range(3):
            add_values(rows[d], bases[2 - order], out[3 * order + d])
        add_values(turn[0], bases[4 - order], out[9 + order])
    out[2] += GRAVITY
    return out


@compiled
def thrusts_at(x: Array, k: int, mass: float, J: Vector3, mixing: Array) -> Four:
    """Rotor thrusts [N] of column k of `motion`."""
    return thrusts_of((x[0, k], x[1, k], x[2, k]), (x[3, k], x[4, k], x[5, k]), (x[6, k], x[7, k], x[8, k]),
                      (x[9, k], x[10, k], x[11, k]), mass, J, mixing)


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
def _segment(coefficients: Array, yaw: Array, duration: float, bases: tuple[Array, ...], mass: float, J: Vector3, mixing: Array) -> Array:
    """Rotor thrusts of a segment at the places of `bases_at`, shape (4, places) [N]."""
    x = motion(coefficients, yaw, duration, bases)
    out = np.empty((4, x.shape[1]))
    for k in range(x.shape[1]):
        out[0, k], out[1, k], out[2, k], out[3, k] = thrusts_at(x, k, mass, J, mixing)
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
def linear_bounds(thrusts: Array, row: Array, coefficients: Array, yaw: Array, durations: Array, low: float, high: float, mass: float,
                  J: Vector3, mixing: Array) -> tuple[Indices, BoundArrays]:
    """Linearised bounds on the rotors that leave [low, high] or are near to it.

    Args:
        thrusts, row: of `sampled`; what lies beyond the limits between the places is made up for at the places.
        coefficients, yaw, durations, mass, J, mixing: as for `sampled`.
        low, high: limits of a rotor's thrust [N].

    Returns:
        (keys, bounds): fields of `linear_bounds.Bounds`: for each rotor and place one bound on a sum of acceleration, jerk and
        snap, and an ascending number of each that names segment, place and rotor. Terms of one derivative at one place stand
        together.
    """
    near, keep = _NEAR * (high - low), _KEEP * (high - low)
    above = low + keep + _BETWEEN * max(thrusts.min() - row[0], 0.0)
    below = high - keep - _BETWEEN * max(row[2] - thrusts.max(), 0.0)
    chosen = (thrusts < low + near) | (thrusts > high - near)
    count = chosen.sum()
    keys, owner = np.empty(count, np.int64), np.empty(3 * count, np.int64)
    segments, orders = np.empty(3 * count, np.int64), np.empty(3 * count, np.int64)
    places, direction = np.empty(3 * count), np.empty((3 * count, 3))
    lower, upper = np.full(count, -np.inf), np.full(count, np.inf)
    r = t = 0
    slopes = np.empty((4, 9))
    for i in range(len(durations)):
        if not chosen[i].any():
            continue
        x = motion(coefficients[i], yaw[i], durations[i], _BASES)
        for k in range(_COUNT):
            if not (chosen[i, 0, k] or chosen[i, 1, k] or chosen[i, 2, k] or chosen[i, 3, k]):
                continue
            for e in range(9):
                step, value = _STEPS[e // 3], x[e, k]
                x[e, k] += step
                moved = thrusts_at(x, k, mass, J, mixing)
                x[e, k] = value
                for q in range(4):
                    slopes[q, e] = (moved[q] - thrusts[i, q, k]) / step
            first = r
            for q in range(4):
                if not chosen[i, q, k]:
                    continue
                known = -thrusts[i, q, k] - GRAVITY * slopes[q, 2]  # the bound is on the acceleration
                for e in range(9):
                    known += slopes[q, e] * x[e, k]
                if thrusts[i, q, k] < low + near:
                    lower[r] = above + known
                else:
                    upper[r] = below + known
                keys[r] = (i * _COUNT + k) * 4 + q
                r += 1
            for order in range(3):
                r = first
                for q in range(4):
                    if chosen[i, q, k]:
                        owner[t], segments[t], places[t], orders[t] = r, i, _PLACES[k], order + 2
                        for d in range(3):
                            direction[t, d] = slopes[q, 3 * order + d]
                        r, t = r + 1, t + 1
    return keys, (owner, segments, places, orders, direction, lower, upper)
