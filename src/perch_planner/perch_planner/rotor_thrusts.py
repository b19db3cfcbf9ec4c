"""Thrusts of the single rotors that a plan asks for: where they leave their range, and linear bounds against it.

Collective thrust within its range [M:eq16] does not suffice: turning takes moments, and near contact, where the thrust is
low, the rotors have little left for them. From the flat outputs, flatness gives thrust, body rates and angular
accelerations [M:eq9-13], and with Euler's equation [M:eq1] and the allocation [P:eq2]

    f = A^-1 (m |f|, J w' + w x J w).

That is no polynomial, so it is sampled, the extrema refined by parabolas through the samples; `rotor_proof` proves what they promise.
It is smooth in acceleration, jerk and snap: its linearisation at the present plan bounds the next one.
"""

from __future__ import annotations

import numpy as np

from perch_core import bernstein
from perch_core.flatness import commanded_frame, heading_derivatives
from perch_core.jit import compiled
from perch_core.vector3 import axpy, cross, norm, times
from perch_core.vehicle import GRAVITY, Vehicle
from perch_planner.bounds import time_derivative

_FINER = 4          # samples from one bound to the next
_SAMPLES = 0.5 - 0.5 * np.cos(np.pi * np.arange(48 * _FINER + 1) / (48 * _FINER))  # dense at the ends, where polynomials turn fastest
_PLACES = _SAMPLES[::_FINER].copy()  # where a rotor is bounded
_SAMPLE_BASES = tuple(bernstein.basis(n, _SAMPLES) for n in range(10, 15))
_PLACE_BASES = tuple(bernstein.basis(n, _PLACES) for n in range(10, 15))
_FREE_FALL = 1e-3   # [m/s^2] below this specific thrust no attitude and so no moment is defined
_ALONG = 1e-6       # sine of the angle between thrust and b2_des below which yaw defines no attitude
_STEPS = (1e-4, 1e-3, 1e-2)  # of acceleration, jerk and snap in the linearisation
_NEAR = 0.1         # rotors this near to a limit are bounded; share of the range
_KEEP = 2e-3        # bounds are set inside by this share of the range,
_BETWEEN = 1.5      # and by this multiple of what was seen between the places


def rotor_model(vehicle: Vehicle) -> tuple[float, tuple[float, float, float], np.ndarray]:
    """What the kernels need of a vehicle: mass [kg], principal inertias [kg m^2], wrench to rotor thrusts, shape (4, 4)."""
    return vehicle.mass, tuple(float(x) for x in vehicle.inertia), np.ascontiguousarray(np.linalg.inv(vehicle.allocation))


@compiled
def thrusts_of(f, j, s, heading, mass, J, mixing):
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


@compiled
def _motion(coefficients, yaw, duration, bases):
    """Specific force, jerk and snap, yaw and its first two derivatives where bases of degree 10 to 14 are given, shape (n, 12)."""
    count = len(bases[0])
    out = np.zeros((count, 12))
    for order in range(2, 5):
        rows, basis = time_derivative(coefficients, order, duration), bases[4 - order]
        for k in range(count):
            for d in range(3):
                for i in range(rows.shape[1]):
                    out[k, 3 * (order - 2) + d] += basis[k, i] * rows[d, i]
    for order in range(3):
        rows, basis = time_derivative(yaw.reshape((1, 15)), order, duration), bases[4 - order]
        for k in range(count):
            for i in range(rows.shape[1]):
                out[k, 9 + order] += basis[k, i] * rows[0, i]
    for k in range(count):
        out[k, 2] += GRAVITY
    return out


@compiled
def _thrusts_at(x, mass, J, mixing):
    """Rotor thrusts [N] of one row of `_motion`."""
    return thrusts_of((x[0], x[1], x[2]), (x[3], x[4], x[5]), (x[6], x[7], x[8]), (x[9], x[10], x[11]), mass, J, mixing)


@compiled
def _vertex(values, k, sign):
    """Place near sample k where the parabola through it and its neighbours is extreme, and that value.

    The parabola runs over the samples' numbers, in which their places are smooth.
    """
    last = len(values) - 1
    middle = min(max(k, 1), last - 1)
    before, here, after = values[middle - 1], values[middle], values[middle + 1]
    bend = before - 2.0 * here + after
    if sign * bend >= 0.0:
        return _SAMPLES[k], values[k]
    shift = 0.5 * (before - after) / bend
    if abs(shift) > 1.0:
        return _SAMPLES[k], values[k]
    return 0.5 - 0.5 * np.cos(np.pi * (middle + shift) / last), here - 0.25 * (before - after) * shift


@compiled
def sampled(coefficients, yaw, durations, mass, J, mixing):
    """Rotor thrusts of a plan: on the 49 places of each segment that may be bounded, and the extrema among all samples.

    Args:
        coefficients: Bernstein coefficients of the position, shape (f, 3, 15) [m].
        yaw: of the heading, shape (f, 15) [rad].
        durations: shape (f,) [s].
        mass, J, mixing: of `rotor_model`.

    Returns:
        (thrusts, row): thrusts, shape (f, 49, 4) [N]; row: least and its time, greatest and its time, refined between
        the samples, shape (4,) [N, s].
    """
    f = len(durations)
    out, fine = np.empty((f, len(_PLACES), 4)), np.empty((4, len(_SAMPLES)))
    row = np.array([np.inf, 0.0, -np.inf, 0.0])
    begin = 0.0
    for i in range(f):
        T = durations[i]
        motion = _motion(coefficients[i], yaw[i], T, _SAMPLE_BASES)
        for k in range(len(_SAMPLES)):
            fine[0, k], fine[1, k], fine[2, k], fine[3, k] = _thrusts_at(motion[k], mass, J, mixing)
        for q in range(4):
            out[i, :, q] = fine[q, ::_FINER]
            place, found = _vertex(fine[q], fine[q].argmin(), -1.0)
            if found < row[0]:
                row[0], row[1] = found, begin + place * T
            place, found = _vertex(fine[q], fine[q].argmax(), 1.0)
            if found > row[2]:
                row[2], row[3] = found, begin + place * T
        begin += T
    return out, row


@compiled
def linear_bounds(thrusts, row, coefficients, yaw, durations, low, high, mass, J, mixing):
    """Linearised bounds on the rotors that leave [low, high] or are near to it.

    Args:
        thrusts, row: of `sampled`; what lies beyond the limits between the places is made up for at the places.
        coefficients, yaw, durations, mass, J, mixing: as for `sampled`.
        low, high: limits of a rotor's thrust [N].

    Returns:
        Fields of `linear_bounds.Bounds`: for each rotor and place one bound on a sum of acceleration, jerk and snap. Terms
        of one derivative at one place stand together.
    """
    near, keep = _NEAR * (high - low), _KEEP * (high - low)
    above = low + keep + _BETWEEN * max(thrusts.min() - row[0], 0.0)
    below = high - keep - _BETWEEN * max(row[2] - thrusts.max(), 0.0)
    count = 0
    for i in range(thrusts.shape[0]):
        for k in range(thrusts.shape[1]):
            for q in range(4):
                count += thrusts[i, k, q] < low + near or thrusts[i, k, q] > high - near
    owner, segments, orders = np.empty(3 * count, np.int64), np.empty(3 * count, np.int64), np.empty(3 * count, np.int64)
    places, direction = np.empty(3 * count), np.empty((3 * count, 3))
    lower, upper = np.full(count, -np.inf), np.full(count, np.inf)
    r = t = 0
    slopes, known = np.empty((4, 9)), np.empty(4)
    for i in range(thrusts.shape[0]):
        motion, ready = np.empty((0, 12)), False
        for k in range(thrusts.shape[1]):
            chosen = 0
            for q in range(4):
                chosen += thrusts[i, k, q] < low + near or thrusts[i, k, q] > high - near
            if chosen == 0:
                continue
            if not ready:
                motion, ready = _motion(coefficients[i], yaw[i], durations[i], _PLACE_BASES), True
            x = motion[k]
            for q in range(4):
                known[q] = -thrusts[i, k, q]
            for e in range(9):
                step, value = _STEPS[e // 3], x[e]
                x[e] += step
                moved = _thrusts_at(x, mass, J, mixing)
                x[e] = value
                if e == 2:
                    value -= GRAVITY  # the bound is on the acceleration
                for q in range(4):
                    slopes[q, e] = (moved[q] - thrusts[i, k, q]) / step
                    known[q] += slopes[q, e] * value
            first = r
            for q in range(4):
                if thrusts[i, k, q] < low + near:
                    lower[r] = above + known[q]
                    r += 1
                elif thrusts[i, k, q] > high - near:
                    upper[r] = below + known[q]
                    r += 1
            for order in range(3):
                r = first
                for q in range(4):
                    if thrusts[i, k, q] < low + near or thrusts[i, k, q] > high - near:
                        owner[t], segments[t], places[t], orders[t] = r, i, _PLACES[k], order + 2
                        for d in range(3):
                            direction[t, d] = slopes[q, 3 * order + d]
                        r, t = r + 1, t + 1
    return owner, segments, places, orders, direction, lower, upper
