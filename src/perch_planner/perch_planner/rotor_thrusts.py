"""Thrusts of the single rotors that a plan asks for: where they leave their range, and linear bounds against it.

Collective thrust within its range [M:eq16] does not suffice: turning takes moments, and near contact, where the thrust is
low, the rotors have little left for them. From the flat outputs, flatness gives thrust, body rates and angular
accelerations [M:eq9-13], and with Euler's equation [M:eq1] and the allocation [P:eq2]

    f = A^-1 (m |f|, J w' + w x J w).

That is no polynomial, so it is *sampled*, the extrema refined by parabolas through the samples; the certificate says
`dense`. It is smooth in acceleration, jerk and snap: its linearisation at the present plan bounds the next one.
"""

from __future__ import annotations

import numpy as np

from perch_core import bernstein
from perch_core.flatness import commanded_frame, heading_derivatives
from perch_core.jit import compiled
from perch_core.vector3 import axpy, cross, norm, times
from perch_core.vehicle import GRAVITY, Vehicle
from perch_planner.bounds import derivative, derivatives_at, value

_PLACES = np.linspace(0.0, 1.0, 49)
_AT10, _AT11, _AT12, _AT13, _AT14 = (np.ascontiguousarray(bernstein.basis(n, _PLACES).T) for n in range(10, 15))
_FREE_FALL = 1e-3   # [m/s^2] below this specific thrust no attitude and so no moment is defined
_ALONG = 1e-6       # sine of the angle between thrust and b2_des below which yaw defines no attitude
_STEPS = (1e-4, 1e-3, 1e-2)  # of acceleration, jerk and snap in the linearisation
_NEAR = 0.1         # rotors this near to a limit are bounded; share of the range
_KEEP = 2e-3        # bounds are set inside by this share of the range,
_BETWEEN = 1.5      # and by this multiple of what was seen between the samples


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
def _heading_at(yaw, duration, s):
    """Yaw and its two derivatives at one place of a segment, 3 floats."""
    return (value(yaw, s), value(derivative(yaw, 1), s) / duration, value(derivative(yaw, 2), s) / duration**2)


@compiled
def _vertex(values, k, sign):
    """Place near sample k where the parabola through it and its neighbours is extreme, and that value."""
    last = len(values) - 1
    middle = min(max(k, 1), last - 1)
    before, here, after = values[middle - 1], values[middle], values[middle + 1]
    bend = before - 2.0 * here + after
    if sign * bend >= 0.0:
        return k / last, values[k]
    shift = 0.5 * (before - after) / bend
    if abs(shift) > 1.0:
        return k / last, values[k]
    return (middle + shift) / last, here - 0.25 * (before - after) * shift


@compiled
def sampled(coefficients, yaw, durations, mass, J, mixing):
    """Rotor thrusts of a plan on 49 places of each segment.

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
    out = np.empty((f, len(_PLACES), 4))
    row = np.array([np.inf, 0.0, -np.inf, 0.0])
    begin = 0.0
    for i in range(f):
        T = durations[i]
        a, j, s = np.empty((3, 13)), np.empty((3, 12)), np.empty((3, 11))
        for d in range(3):
            a[d] = derivative(coefficients[i, d], 2) / T**2
            j[d] = derivative(coefficients[i, d], 3) / T**3
            s[d] = derivative(coefficients[i, d], 4) / T**4
        a, j, s = a @ _AT12, j @ _AT11, s @ _AT10
        h, dh = yaw[i] @ _AT14, derivative(yaw[i], 1) @ _AT13 / T
        ddh = derivative(yaw[i], 2) @ _AT12 / T**2
        for k in range(len(_PLACES)):
            out[i, k] = thrusts_of(
                (a[0, k], a[1, k], a[2, k] + GRAVITY), (j[0, k], j[1, k], j[2, k]), (s[0, k], s[1, k], s[2, k]),
                (h[k], dh[k], ddh[k]), mass, J, mixing)
        for q in range(4):
            place, found = _vertex(out[i, :, q], out[i, :, q].argmin(), -1.0)
            if found < row[0]:
                row[0], row[1] = found, begin + place * T
            place, found = _vertex(out[i, :, q], out[i, :, q].argmax(), 1.0)
            if found > row[2]:
                row[2], row[3] = found, begin + place * T
        begin += T
    return out, row


@compiled
def linear_bounds(thrusts, row, coefficients, yaw, durations, low, high, mass, J, mixing):
    """Linearised bounds on the rotors that leave [low, high] or are near to it.

    Args:
        thrusts, row: of `sampled`; what lies beyond the limits between the samples is made up for at the samples.
        coefficients, yaw, durations, mass, J, mixing: as for `sampled`.
        low, high: limits of a rotor's thrust [N].

    Returns:
        (segments, places, gradients, lower, upper): where, shape (n,); gradients by acceleration, jerk and snap, shape
        (n, 3, 3); bounds of the sum of gradients times derivatives, shape (n,).
    """
    near, keep = _NEAR * (high - low), _KEEP * (high - low)
    above = low + keep + _BETWEEN * max(thrusts.min() - row[0], 0.0)
    below = high - keep - _BETWEEN * max(row[2] - thrusts.max(), 0.0)
    chosen = np.zeros(thrusts.shape, np.int8)
    count = 0
    for i in range(thrusts.shape[0]):
        for k in range(thrusts.shape[1]):
            for q in range(4):
                if thrusts[i, k, q] < low + near:
                    chosen[i, k, q] = 1
                elif thrusts[i, k, q] > high - near:
                    chosen[i, k, q] = 2
                count += chosen[i, k, q] > 0
    segments, places, gradients = np.empty(count, np.int64), np.empty(count), np.empty((count, 3, 3))
    lower, upper = np.full(count, -np.inf), np.full(count, np.inf)
    n = 0
    for i in range(thrusts.shape[0]):
        for k in range(thrusts.shape[1]):
            if not chosen[i, k].any():
                continue
            place = _PLACES[k]
            x = derivatives_at(coefficients[i], durations[i], place, 5)[2:]
            heading = _heading_at(yaw[i], durations[i], place)
            slopes = np.empty((4, 3, 3))
            for order in range(3):
                for d in range(3):
                    z = x.copy()
                    z[order, d] += _STEPS[order]
                    moved = thrusts_of((z[0, 0], z[0, 1], z[0, 2] + GRAVITY), (z[1, 0], z[1, 1], z[1, 2]),
                                       (z[2, 0], z[2, 1], z[2, 2]), heading, mass, J, mixing)
                    for q in range(4):
                        slopes[q, order, d] = (moved[q] - thrusts[i, k, q]) / _STEPS[order]
            for q in range(4):
                if chosen[i, k, q]:
                    known = (slopes[q] * x).sum() - thrusts[i, k, q]
                    segments[n], places[n] = i, place
                    gradients[n] = slopes[q]
                    if chosen[i, k, q] == 1:
                        lower[n] = above + known
                    else:
                        upper[n] = below + known
                    n += 1
    return segments, places, gradients, lower, upper
