"""All limits of a plan, checked on its published Bernstein coefficients."""

from __future__ import annotations

from math import sqrt

import numpy as np

from perch_core import bernstein
from perch_core.arrays import Array
from perch_core.jit import compiled
from perch_core.vehicle import GRAVITY
from perch_planner.body_rate_bound import prove_rate, rate_coarse_bound, squared_rate
from perch_planner.bounds import magnitude, maximum, smallest, squared, time_derivative
from perch_planner.clearance_bound import PLATE_SLACK, least_distance, prove_clearance, surface_distance

THRUST, SPEED, HEIGHT, CLEARANCE, BODY_RATE, ROTOR_THRUST = range(6)
"""Rows of the results; thrust is the specific thrust |a + g e3|. `check` gives the first five, which are proved."""

NAMES = ("thrust", "speed", "height", "clearance", "body_rate", "rotor_thrust")

MINIMUM, MINIMUM_AT, MAXIMUM, MAXIMUM_AT, HOLDS = range(5)
"""Columns of the results: proved bounds, the times of the samples nearest to them, and whether the limits hold."""

_PLACES = np.linspace(0.0, 1.0, 13)  # where clearance and rate are sampled
_AT11, _AT12, _AT13, _AT14 = (bernstein.basis(n, _PLACES).T.copy() for n in (11, 12, 13, 14))

_RELATIVE = 1e-3   # width of the enclosures, relative to the quantity's largest value
_FINE = 1e-10      # where a limit falls inside the enclosure


@compiled
def specific_force(coefficients: Array, duration: float) -> Array:
    """Specific force f = a + g e3 of a segment: (3, 15) -> Bernstein coefficients (3, 13), degree 12 [m/s^2]. [defines M:eq9]"""
    force = time_derivative(coefficients, 2, duration)
    for k in range(force.shape[1]):
        force[2, k] += GRAVITY
    return force


@compiled
def _enclose(coefficients: Array, limit: float, attained_elsewhere: float) -> tuple[float, float, float]:
    """Attained maximum, proved maximum and place, enclosed above the lower of the limit and the maximum attained elsewhere.

    The enclosure is refined where the limit lies between attained and proved maximum.
    """
    scale, floor = magnitude(coefficients), min(attained_elsewhere, limit)
    attained, proved, place = maximum(coefficients, _RELATIVE * scale, floor)
    if attained <= limit < proved:
        attained, proved, place = maximum(coefficients, _FINE * scale, floor)
    return attained, proved, place


@compiled
def thrust_extrema(coefficients: Array, durations: Array, low: float, high: float) -> tuple[Array, float, float, Array, Array]:
    """Least and greatest specific thrust of each segment. [M:eq9] [defines M:eq16]

    A segment's extrema are enclosed closely where they violate a limit or are those of the whole plan; the bounds of other
    segments are proved, but looser.

    Args:
        coefficients: shape (f, 3, 15) [m].
        durations: shape (f,) [s].
        low, high: limits of the specific thrust [m/s^2].

    Returns:
        (extrema, least, most, forces, squares): extrema, shape (f, 6): attained minimum, proved minimum, place, attained maximum,
        proved maximum, place; proved minimum and maximum of the whole plan [m/s^2]; f and |f|^2, shapes (f, 3, 13) and (f, 25).
    """
    f = len(durations)
    out, forces = np.empty((f, 6)), np.empty((f, 3, 13))
    upper, lower = np.empty((f, 25)), np.empty((f, 25))  # |f|^2, -|f|^2
    least, most = -np.inf, -np.inf  # attained, of -|f|^2 and |f|^2
    for i in range(f):
        forces[i] = specific_force(coefficients[i], durations[i])
        row = squared(forces[i])
        for k in range(25):
            upper[i, k], lower[i, k] = row[k], -row[k]
        least, most = max(least, max(-row[0], -row[24])), max(most, max(row[0], row[24]))
    proved_least, proved_most = np.inf, -np.inf
    for i in range(f):
        attained, proved, place = _enclose(lower[i], -low * low, least)
        least = max(least, attained)
        out[i, 0], out[i, 1], out[i, 2] = sqrt(max(-attained, 0.0)), sqrt(max(-proved, 0.0)), place
        attained, proved, place = _enclose(upper[i], high * high, most)
        most = max(most, attained)
        out[i, 3], out[i, 4], out[i, 5] = sqrt(attained), sqrt(proved), place
        proved_least, proved_most = min(proved_least, out[i, 1]), max(proved_most, out[i, 4])
    return out, proved_least, proved_most, forces, upper


@compiled
def _values(coefficients: Array, basis: Array) -> Array:
    """Values of several polynomials at the places of a table, shapes (r, n + 1), (n + 1, places) -> (r, places)."""
    out = np.zeros((coefficients.shape[0], basis.shape[1]))
    for d in range(coefficients.shape[0]):
        for i in range(coefficients.shape[1]):
            for k in range(basis.shape[1]):
                out[d, k] += coefficients[d, i] * basis[i, k]
    return out


@compiled
def _sample(distance: Array, force: Array, jerk: Array, yaw: Array, yaw_rate: Array, s3: Array, extension: float
            ) -> tuple[float, float, float, float]:
    """Least clearance and greatest body rate over fixed places of a segment: (gap, place, rate, place).

    Arrays are Bernstein coefficients with one row for each polynomial.
    """
    gap, gap_place, rate, rate_place = np.inf, 0.0, 0.0, 0.0
    f, j = _values(force, _AT12), _values(jerk, _AT11)
    dist, heading, turn = _values(distance, _AT14), _values(yaw, _AT14), _values(yaw_rate, _AT13)
    count = len(_PLACES)
    for k in range(count):
        f_x, f_y, f_z = f[0, k], f[1, k], f[2, k]
        f2 = max(f_x * f_x + f_y * f_y + f_z * f_z, 1e-12)
        along = f_x * s3[0] + f_y * s3[1] + f_z * s3[2]
        here = dist[0, k] - extension * sqrt(max(1.0 - along * along / f2, 0.0))
        if here < gap:
            gap, gap_place = here, k / (count - 1)
        here = squared_rate(f_x, f_y, f_z, j[0, k], j[1, k], j[2, k], heading[0, k], turn[0, k])
        if here > rate:
            rate, rate_place = here, k / (count - 1)
    return gap, gap_place, sqrt(rate), rate_place


@compiled
def _widen(out: Array, attained: Array, row: int, column: int, value: float, proved: float, time: float) -> None:
    """Update the results with the attained and proved extremum of a segment; column MINIMUM or MAXIMUM."""
    sign = 1.0 if column == MAXIMUM else -1.0
    if sign * proved > sign * out[row, column]:
        out[row, column] = proved
    if sign * value > sign * attained[row, column]:
        attained[row, column], out[row, column + 1] = value, time


@compiled
def _within(vector: Array, limit: float) -> bool:
    """Whether the Bernstein coefficients of a polynomial vector, and so all its values, are within a limit."""
    for k in range(vector.shape[1]):
        if vector[0, k] ** 2 + vector[1, k] ** 2 + vector[2, k] ** 2 > limit * limit:
            return False
    return True


@compiled
def _record_failure(where: Array, row: int, segment: int, place: float) -> None:
    """Record the first place at which the proof of a limit failed."""
    if where[row, 0] < 0.0:
        where[row, 0], where[row, 1] = segment, place


@compiled
def check(coefficients: Array, yaw: Array, durations: Array, thrust: Array, forces: Array, squares: Array, p_S: Array, v_S: Array, s3: Array,
          low_thrust: float, high_thrust: float, speed: float, low_height: float, high_height: float, extension: float,
          clearance: float, offset: float, rate: float) -> tuple[Array, Array, bool]:
    """Prove every limit of a plan, or find where it fails.

    Args:
        coefficients: Bernstein coefficients of the position, shape (f, 3, 15) [m].
        yaw: of the heading, shape (f, 15) [rad].
        durations: shape (f,) [s].
        thrust, forces, squares: extrema, f and |f|^2 from `thrust_extrema`.
        p_S, v_S, s3: point of the surface at time 0 [m], its velocity [m/s], outward normal, each shape (3,).
        low_thrust, high_thrust: limits of the specific thrust [m/s^2].
        speed: limit [m/s].
        low_height, high_height: limits [m].
        extension: radius of the vehicle's disc [m].
        clearance: least distance of its rim from the surface [m]; where it is negative, also that of its plate.
        offset: distance of the plate below the centre of mass [m].
        rate: limit of |omega| [rad/s].

    Returns:
        (results, where, holds): results, shape (5, 5), rows and columns as named above; where, shape (5, 2): segment and
        place where the proof of each quantity first failed, segment -1 where none failed; whether all limits hold.
    """
    f = len(durations)
    out, where = np.empty((5, 5)), np.empty((5, 2))
    for row in range(5):
        out[row, 0], out[row, 1], out[row, 2], out[row, 3], out[row, 4] = np.inf, 0.0, -np.inf, 0.0, 1.0
        where[row, 0], where[row, 1] = -1.0, -1.0
    attained = out.copy()
    begin = 0.0
    begins = np.empty(f)
    down = np.empty((1, 15))
    for i in range(f):
        T, c = durations[i], coefficients[i]
        begins[i] = begin
        _widen(out, attained, THRUST, MINIMUM, thrust[i, 0], thrust[i, 1], begin + T * thrust[i, 2])
        _widen(out, attained, THRUST, MAXIMUM, thrust[i, 3], thrust[i, 4], begin + T * thrust[i, 5])
        if thrust[i, 1] < low_thrust:
            _record_failure(where, THRUST, i, thrust[i, 2])
        if thrust[i, 4] > high_thrust:
            _record_failure(where, THRUST, i, thrust[i, 5])

        velocity = time_derivative(c, 1, T)
        reached = max(attained[SPEED, MAXIMUM], 0.0)
        if not _within(velocity, min(reached, speed)):
            here, proved, place = _enclose(squared(velocity), speed * speed, reached * reached)
            _widen(out, attained, SPEED, MAXIMUM, sqrt(max(here, 0.0)), sqrt(max(proved, 0.0)), begin + T * place)
            if proved > speed * speed:
                _record_failure(where, SPEED, i, place)

        for k in range(15):
            down[0, k] = -c[2, k]
        here, proved, place = _enclose(down[0], -low_height, -attained[HEIGHT, MINIMUM])
        _widen(out, attained, HEIGHT, MINIMUM, -here, -proved, begin + T * place)
        if -proved < low_height:
            _record_failure(where, HEIGHT, i, place)
        here, proved, place = _enclose(c[2], high_height, attained[HEIGHT, MAXIMUM])
        _widen(out, attained, HEIGHT, MAXIMUM, here, proved, begin + T * place)
        if proved > high_height:
            _record_failure(where, HEIGHT, i, place)
        begin += T

    jerks, distances = np.empty((f, 3, 12)), np.empty((f, 15))
    # Backwards, as the vehicle turns and comes near at the end: most segments before need no samples then.
    gap_sampled, rate_sampled = np.inf, min(1e-3, 0.5 * rate)
    coarse = np.empty(f)
    for i in range(f - 1, -1, -1):
        T, c, heading = durations[i], coefficients[i], yaw[i:i + 1]
        jerks[i], distances[i] = time_derivative(c, 3, T), surface_distance(c, T, begins[i], p_S, v_S, s3)
        coarse[i] = rate_coarse_bound(forces[i], squares[i], jerks[i], yaw[i], T)
        if smallest(distances[i]) - extension >= gap_sampled and coarse[i] <= min(rate_sampled, 0.999 * rate):
            continue
        gap, gap_place, rate_here, rate_place = _sample(distances[i:i + 1], forces[i], jerks[i], heading,
                                                        time_derivative(heading, 1, T), s3, extension)
        if gap < gap_sampled:
            gap_sampled, out[CLEARANCE, MINIMUM_AT] = gap, begins[i] + T * gap_place
        if rate_here > rate_sampled:
            rate_sampled, out[BODY_RATE, MAXIMUM_AT] = rate_here, begins[i] + T * rate_place
        if rate_here >= rate:
            where[BODY_RATE, 0], where[BODY_RATE, 1] = i, rate_place  # in the end the first segment that is too fast
    out[SPEED, MINIMUM] = out[BODY_RATE, MINIMUM] = 0.0
    out[CLEARANCE, MAXIMUM] = np.inf
    out[CLEARANCE, MINIMUM], i, place = prove_clearance(distances, forces, squares, s3, extension, clearance, gap_sampled)
    if i >= 0:
        _record_failure(where, CLEARANCE, i, place)
        if gap_sampled < clearance:
            out[CLEARANCE, MINIMUM] = gap_sampled
    nearest, i, place = least_distance(distances, offset)
    if nearest < offset - PLATE_SLACK:
        if nearest - offset < out[CLEARANCE, MINIMUM]:
            out[CLEARANCE, MINIMUM], out[CLEARANCE, MINIMUM_AT] = nearest - offset, begins[i] + place * durations[i]
        if nearest < offset + min(clearance, 0.0) - PLATE_SLACK:
            _record_failure(where, CLEARANCE, i, place)
    out[BODY_RATE, MAXIMUM] = np.inf if rate_sampled < rate else rate_sampled
    if rate_sampled < rate:  # else a sample is too fast
        out[BODY_RATE, MAXIMUM], i, place, found, found_at = prove_rate(forces, squares, jerks, yaw, durations, coarse, rate,
                                                                        rate_sampled)
        if i >= 0:
            _record_failure(where, BODY_RATE, i, place)
        if found >= 0:
            out[BODY_RATE, MAXIMUM_AT] = begins[found] + found_at * durations[found]
    holds = True
    for k in range(5):
        if where[k, 0] >= 0.0:
            out[k, HOLDS] = 0.0
            holds = False
    return out, where, holds
