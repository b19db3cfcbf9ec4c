"""Linear bounds that steer the next quadratic program away from a violated limit.

An upper limit on a norm, |u| <= b, is convex: `n . u <= b` with n = u / |u| excludes the present plan and no plan that
keeps the limit. The same holds for height and the surface's plane. The limits of the least thrust, the rim and the body
rate are not convex; their cuts select one side. Cuts prove nothing: every limit is checked afterwards.
"""

from __future__ import annotations

from math import cos, sin

import numpy as np

from perch_core.arrays import Array
from perch_core.jit import compiled
from perch_core.vector3 import cross, dot
from perch_core.vehicle import GRAVITY
from perch_planner.body_rate_bound import spin_rate
from perch_planner.bounds import derivative, derivatives_at, value
from perch_planner.linear_bounds import BoundArrays, no_bounds
from perch_planner.plan_checks import BODY_RATE, CLEARANCE, HEIGHT, SPEED

_UPPER_CUT_SHARE = 0.995        # cuts from above are set to this share of the limit, so that few rounds suffice
_RIM_FACTOR = 1.1               # times the rim's reach at the present tilt, as the tilt changes with the cut
_RATE_CUT_SHARE = 0.95          # of the body rate's limit
_LOWER_CUT_FACTOR = 1.02        # cuts of the thrust from below
_HEIGHT_INSET = 2e-3            # [m]
_PLATE_SPEED = 0.02             # [m/s] of an approach that the inset of the plate's cuts permits
_NEIGHBOUR_OFFSET = 1.0 / 24.0  # of a segment: peaks are flat, and a cut at the peak alone moves it to the side
_NEIGHBOUR_THRUST_SHARE = 0.97  # of the limit; a peak is cut beside its place where the thrust is above this share


@compiled
def _specific_force(coefficients: Array, duration: float, place: float) -> tuple[float, float, float, float]:
    """Specific force f = a + g e3 at one place of a segment, as three floats, and its norm [m/s^2]."""
    f = derivatives_at(coefficients, duration, place, 3)[2]
    f_z = f[2] + GRAVITY
    return f[0], f[1], f_z, np.sqrt(f[0] * f[0] + f[1] * f[1] + f_z * f_z)


@compiled
def thrust_cuts(coefficients: Array, durations: Array, extrema: Array, low: float, high: float, fallback_direction: Array) -> BoundArrays:
    """Cuts where the specific thrust leaves [low, high]. [M:eq16]

    Args:
        coefficients: shape (f, 3, 15).
        durations: shape (f,) [s].
        extrema: result of `plan_checks.thrust_extrema`.
        low, high: limits of the specific thrust [m/s^2].
        fallback_direction: unit vector of the cut where the thrust nearly vanishes, shape (3,).

    Returns:
        Fields of `Bounds`.
    """
    capacity = 0
    for i in range(len(durations)):
        capacity += 3 * (extrema[i, 4] > high) + (extrema[i, 1] < low)
    owner, segments, places, orders, direction, lower, upper = no_bounds(capacity, capacity)
    r = 0
    for i in range(len(durations)):
        if extrema[i, 4] > high:
            for beside in range(-1, 2):
                place = extrema[i, 5] + beside * _NEIGHBOUR_OFFSET
                if place < 0.0 or place > 1.0:
                    continue
                x, y, z, norm = _specific_force(coefficients[i], durations[i], place)
                if beside != 0 and norm < _NEIGHBOUR_THRUST_SHARE * high:
                    continue
                owner[r], segments[r], places[r] = r, i, place
                direction[r, 0], direction[r, 1], direction[r, 2] = x / norm, y / norm, z / norm
                upper[r] = _UPPER_CUT_SHARE * high - direction[r, 2] * GRAVITY
                r += 1
        if extrema[i, 1] < low:
            x, y, z, norm = _specific_force(coefficients[i], durations[i], extrema[i, 2])
            owner[r], segments[r], places[r] = r, i, extrema[i, 2]
            if norm > 0.5 * low:
                direction[r, 0], direction[r, 1], direction[r, 2] = x / norm, y / norm, z / norm
            else:
                direction[r, 0], direction[r, 1], direction[r, 2] = fallback_direction[0], fallback_direction[1], fallback_direction[2]
            lower[r] = _LOWER_CUT_FACTOR * low - direction[r, 2] * GRAVITY
            r += 1
    return owner[:r], segments[:r], places[:r], orders[:r], direction[:r], lower[:r], upper[:r]


def turn_direction(heading: float) -> Array:
    """Unit vector through which the thrust turns from upward to s3: opposite to the approach heading [rad], shape (3,)."""
    return np.array([-cos(heading), -sin(heading), 0.0])


@compiled
def limit_cuts(where: Array, coefficients: Array, yaw: Array, durations: Array, p_S: Array, v_S: Array, s3: Array, low_height: float,
               high_height: float, speed: float, rate: float, extension: float, clearance: float, offset: float) -> BoundArrays:
    """Cuts where speed, height, clearance or body rate could not be proved.

    Args:
        where: places where a proof failed, from `plan_checks.check`.
        coefficients, yaw, durations: the plan.
        p_S, v_S, s3, low_height, high_height, speed, rate, extension, clearance, offset: as for `plan_checks.check`.

    Returns:
        Fields of `Bounds`.
    """
    owner, segments, places, orders, direction, lower, upper = no_bounds(9, 6)
    t = r = 0
    for row in (SPEED, HEIGHT, CLEARANCE, BODY_RATE):
        if where[row, 0] < 0.0:
            continue
        i = int(where[row, 0])
        for beside in range(-1, 2):
            s = where[row, 1] + beside * _NEIGHBOUR_OFFSET
            if beside != 0 and (row != BODY_RATE or s < 0.0 or s > 1.0):
                continue
            x = derivatives_at(coefficients[i], durations[i], s, 4)
            owner[t], segments[t], places[t] = r, i, s
            f, j = x[2], x[3]
            f[2] += GRAVITY
            squared = max(dot(f, f), 1e-9)
            if row == SPEED:
                norm = np.sqrt(dot(x[1], x[1]))
                orders[t], upper[r] = 1, _UPPER_CUT_SHARE * speed
                for d in range(3):
                    direction[t, d] = x[1, d] / norm
            elif row == HEIGHT:
                orders[t], direction[t, 2] = 0, 1.0
                lower[r], upper[r] = low_height + _HEIGHT_INSET, high_height - _HEIGHT_INSET
            elif row == CLEARANCE:
                # The rim's reach at the present tilt: right to first order where the tilt does not change.
                tilt = np.sqrt(max(1.0 - dot(f, s3) ** 2 / squared, 0.0))
                time = durations[:i].sum() + s * durations[i]
                surface = dot(s3, p_S) + time * dot(s3, v_S)
                orders[t] = 0
                if extension * tilt + clearance < dot(s3, x[0]) - surface < offset:  # the plate's proof failed, not the rim's
                    lower[r] = surface + offset + min(clearance, 0.0) + min(_HEIGHT_INSET, _PLATE_SPEED * (durations.sum() - time))
                else:
                    lower[r] = surface + _RIM_FACTOR * extension * tilt + _HEIGHT_INSET + clearance
                for d in range(3):
                    direction[t, d] = s3[d]
            else:
                # |j across f| <= u |f|, linear in both at the present directions.
                norm, along = np.sqrt(squared), dot(f, j) / squared
                across = np.sqrt(max(dot(j, j) - along * dot(f, j), 0.0))
                if across <= 1e-6:
                    continue
                # The spin falls with the tilt's rate: what is left for the tilt is its present share of the whole.
                turning = cross(f, j)
                spin = spin_rate(f[0], f[1], f[2], turning[0], turning[1], value(yaw[i], s),
                                 value(derivative(yaw[i], 1), s) / durations[i])
                share = _RATE_CUT_SHARE * rate / np.sqrt(1.0 + (spin * norm / across) ** 2)
                owner[t + 1], segments[t + 1], places[t + 1] = r, i, s
                orders[t] = 3
                upper[r] = share * f[2] / norm * GRAVITY
                for d in range(3):
                    direction[t, d] = (j[d] - along * f[d]) / across
                    direction[t + 1, d] = -share * f[d] / norm
                t += 1
            t, r = t + 1, r + 1
    return owner[:t], segments[:t], places[:t], orders[:t], direction[:t], lower[:r], upper[:r]
