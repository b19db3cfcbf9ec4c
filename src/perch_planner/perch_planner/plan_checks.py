"""All limits of a plan, checked on its published Bernstein coefficients. [M:eq16, M:alg1]"""

from __future__ import annotations

from math import cos, sin, sqrt

import numpy as np

from perch_core import bernstein
from perch_core.jit import compiled
from perch_core.vehicle import GRAVITY
from perch_planner.body_rate_bound import rate_at, rate_coarse_bound, rate_parts, rate_stays_below
from perch_planner.bounds import BELOW, VIOLATED, cross, derivative, dot, maximum, product, stays_below

THRUST, SPEED, HEIGHT, CLEARANCE, BODY_RATE, ROTOR_THRUST = range(6)
"""Rows of the results; thrust is the specific thrust |a + g e3|. `check` gives the first five, which are proved."""

NAMES = ("thrust", "speed", "height", "clearance", "body_rate", "rotor_thrust")

MINIMUM, MINIMUM_AT, MAXIMUM, MAXIMUM_AT, HOLDS = range(5)
"""Columns of the results: proved bounds, the times of the samples nearest to them, and whether the limits hold."""

_PLACES = np.linspace(0.0, 1.0, 13)  # where clearance and rate are sampled
_AT11, _AT12, _AT13, _AT14 = (np.ascontiguousarray(bernstein.basis(n, _PLACES).T) for n in (11, 12, 13, 14))

_RELATIVE = 1e-3   # width of the enclosures, relative to the quantity's largest value
_RATE_ROUNDS = 8
_FINE = 1e-10      # where a limit falls inside the enclosure
_CLEARANCE_SLACK = 1e-9  # [m^4/s^4] the rim may touch the surface at the contact itself


@compiled
def specific_force(coefficients, duration):
    """f = a + g e3 of a segment, Bernstein coefficients of degree 12, shape (3, 15) -> (3, 13) [m/s^2]."""
    force = np.empty((3, 13))
    for d in range(3):
        force[d] = derivative(coefficients[d], 2) / duration**2
    force[2] += GRAVITY
    return force


@compiled
def _enclose(coefficients, limit):
    """Attained maximum, proved maximum and place; finer where the limit lies between the two."""
    scale = np.abs(coefficients).max()
    attained, proved, place = maximum(coefficients, _RELATIVE * scale)
    if attained <= limit < proved:
        attained, proved, place = maximum(coefficients, _FINE * scale)
    return attained, proved, place


@compiled
def thrust_extrema(coefficients, durations, low, high):
    """Least and greatest specific thrust of each segment. [M:eq9, M:eq16]

    Args:
        coefficients: shape (f, 3, 15) [m].
        durations: shape (f,) [s].
        low, high: limits of the specific thrust [m/s^2].

    Returns:
        Shape (f, 6): attained minimum, proved minimum, place, attained maximum, proved maximum, place [m/s^2].
    """
    out = np.empty((len(durations), 6))
    for i in range(len(durations)):
        force = specific_force(coefficients[i], durations[i])
        squared = dot(force, force)
        attained, proved, place = _enclose(-squared, -low * low)
        out[i, 0], out[i, 1], out[i, 2] = sqrt(max(-attained, 0.0)), sqrt(max(-proved, 0.0)), place
        attained, proved, place = _enclose(squared, high * high)
        out[i, 3], out[i, 4], out[i, 5] = sqrt(attained), sqrt(proved), place
    return out


@compiled
def surface_distance(coefficients, duration, begin, p_S, v_S, s3):
    """Distance of the centre of mass from the moving surface, Bernstein coefficients, shape (15,) [m]."""
    out = np.zeros(coefficients.shape[1])
    last = len(out) - 1
    for d in range(3):
        for k in range(last + 1):
            out[k] += s3[d] * (coefficients[d, k] - p_S[d] - v_S[d] * (begin + duration * k / last))
    return out


@compiled
def _rim_clears(distance, force, s3, extension, gap):
    """Whether distance - extension sin(tilt) > gap is proved on the segment, and a place where it is doubtful.

    The rim of a disc around the centre of mass reaches extension sin(tilt) towards the surface, and
    sin(tilt) = |f x s3| / |f|: so (distance - gap)^2 |f|^2 > extension^2 |f x s3|^2 with distance > gap.
    """
    reduced = distance - gap
    verdict, place = stays_below(-reduced, _CLEARANCE_SLACK)
    if verdict != BELOW:
        return False, place
    normal = np.empty((3, 1))
    normal[:, 0] = s3
    tilt = cross(force, normal)
    far = product(product(reduced, reduced), dot(force, force))
    near = product(extension**2 * dot(tilt, tilt), np.ones(len(far) - 24))
    verdict, place = stays_below(near - far, _CLEARANCE_SLACK)
    return verdict == BELOW, place


@compiled
def _sample(distance, force, jerk, yaw, yaw_rate, s3, extension):
    """Least clearance and greatest body rate over fixed places of a segment: (gap, place, rate, place)."""
    gap, gap_at, rate, rate_at_ = np.inf, 0.0, 0.0, 0.0
    f, j = force @ _AT12, jerk @ _AT11
    dist, heading, turn = distance @ _AT14, yaw @ _AT14, yaw_rate @ _AT13
    count = _AT14.shape[1]
    for k in range(count):
        f_x, f_y, f_z, j_x, j_y, j_z = f[0, k], f[1, k], f[2, k], j[0, k], j[1, k], j[2, k]
        f2 = max(f_x * f_x + f_y * f_y + f_z * f_z, 1e-12)
        along = f_x * s3[0] + f_y * s3[1] + f_z * s3[2]
        here = dist[k] - extension * sqrt(max(1.0 - along * along / f2, 0.0))
        if here < gap:
            gap, gap_at = here, k / (count - 1)
        x_x, x_y, x_z = f_y * j_z - f_z * j_y, f_z * j_x - f_x * j_z, f_x * j_y - f_y * j_x
        d_x, d_y = -sin(heading[k]), cos(heading[k])
        lean = d_x * f_x + d_y * f_y
        across = max(f2 - lean * lean, 1e-12)
        spin = (turn[k] * f_z * sqrt(f2) + lean * (d_x * x_x + d_y * x_y) / sqrt(f2)) / across
        here = (x_x * x_x + x_y * x_y + x_z * x_z) / (f2 * f2) + spin * spin
        if here > rate:
            rate, rate_at_ = here, k / (count - 1)
    return gap, gap_at, sqrt(rate), rate_at_


@compiled
def _widen(out, row, minimum, at_minimum, maximum_, at_maximum):
    if minimum < out[row, 0]:
        out[row, 0], out[row, 1] = minimum, at_minimum
    if maximum_ > out[row, 2]:
        out[row, 2], out[row, 3] = maximum_, at_maximum


@compiled
def check(coefficients, yaw, durations, thrust, p_S, v_S, s3, low_thrust, high_thrust, speed, low_height, high_height,
          extension, clearance, rate):
    """Prove every limit of a plan, or find where it fails.

    Args:
        coefficients: Bernstein coefficients of the position, shape (f, 3, 15) [m].
        yaw: of the heading, shape (f, 15) [rad].
        durations: shape (f,) [s].
        thrust: of `thrust_extrema`.
        p_S, v_S, s3: point of the surface at time 0 [m], its velocity [m/s], outward normal, each shape (3,).
        low_thrust, high_thrust: limits of the specific thrust [m/s^2].
        speed: limit [m/s].
        low_height, high_height: limits [m].
        extension: radius of the vehicle's disc [m].
        clearance: least distance of its rim from the surface [m].
        rate: limit of |omega| [rad/s].

    Returns:
        (results, where): results, shape (5, 5), rows and columns as named above; where, shape (5, 2): segment and
        place of the first doubt of each quantity, segment -1 where there is none.
    """
    f = len(durations)
    out = np.zeros((5, 5))
    out[:, 0], out[:, 2] = np.inf, -np.inf
    out[:, 4] = 1.0
    where = np.full((5, 2), -1.0)
    gap_wanted, rate_wanted = np.inf, 1e-3
    begin = 0.0
    coarse = np.empty(f)
    for i in range(f):
        T, c = durations[i], coefficients[i]
        _widen(out, 0, thrust[i, 1], begin + T * thrust[i, 2], thrust[i, 4], begin + T * thrust[i, 5])
        velocity = np.empty((3, 14))
        for d in range(3):
            velocity[d] = derivative(c[d], 1) / T
        attained, proved, place = _enclose(dot(velocity, velocity), speed * speed)
        _widen(out, 1, 0.0, 0.0, sqrt(max(proved, 0.0)), begin + T * place)
        if proved > speed * speed and where[1, 0] < 0.0:
            where[1, 0], where[1, 1] = i, place
        attained, proved, place = _enclose(-c[2], -low_height)
        if -proved < low_height and where[2, 0] < 0.0:
            where[2, 0], where[2, 1] = i, place
        attained2, proved2, place2 = _enclose(c[2], high_height)
        if proved2 > high_height and where[2, 0] < 0.0:
            where[2, 0], where[2, 1] = i, place2
        _widen(out, 2, -proved, begin + T * place, proved2, begin + T * place2)
        force = specific_force(c, T)
        distance = surface_distance(c, T, begin, p_S, v_S, s3)
        jerk = np.empty((3, 12))
        for d in range(3):
            jerk[d] = derivative(c[d], 3) / T**3
        gap, gap_at, sampled, rate_at_ = _sample(distance, force, jerk, yaw[i], derivative(yaw[i], 1) / T, s3, extension)
        if gap < gap_wanted:
            gap_wanted, out[3, 1] = gap, begin + T * gap_at
        coarse[i] = rate_coarse_bound(force, jerk, yaw[i], T)
        if sampled > rate_wanted:
            rate_wanted, out[4, 3] = sampled, begin + T * rate_at_
        if thrust[i, 1] < low_thrust and where[0, 0] < 0.0:
            where[0, 0], where[0, 1] = i, thrust[i, 2]
        if thrust[i, 4] > high_thrust and where[0, 0] < 0.0:
            where[0, 0], where[0, 1] = i, thrust[i, 5]
        begin += T
    _prove_clearance(out, where, coefficients, durations, p_S, v_S, s3, extension, clearance, gap_wanted)
    _prove_rate(out, where, coefficients, yaw, durations, coarse, rate, rate_wanted)
    for k in range(5):
        if where[k, 0] >= 0.0:
            out[k, 4] = 0.0
    return out, where


@compiled
def _prove_clearance(out, where, coefficients, durations, p_S, v_S, s3, extension, limit, sampled):
    """Prove a clearance near the sampled one, or else that the limit holds, or else find where it fails."""
    out[3, 0], out[3, 2] = -np.inf, np.inf
    for gap in (0.98 * sampled - 1e-3, 0.9 * sampled - 5e-3, limit):
        if gap < limit:
            continue
        begin, failed, place = 0.0, -1, 0.0
        for i in range(len(durations)):
            distance = surface_distance(coefficients[i], durations[i], begin, p_S, v_S, s3)
            clears = distance.min() > gap + extension
            if not clears:
                clears, place = _rim_clears(distance, specific_force(coefficients[i], durations[i]), s3, extension, gap)
            if not clears:
                failed = i
                break
            begin += durations[i]
        if failed < 0:
            out[3, 0] = gap
            return
        if gap == limit:
            where[3, 0], where[3, 1] = failed, place


@compiled
def _prove_rate(out, where, coefficients, yaw, durations, coarse, limit, sampled):
    """Prove a body rate near the greatest that is attained, or else that the limit holds, or else where it fails."""
    out[4, 0], out[4, 2] = 0.0, np.inf
    attained, slack = sampled, 1.04
    parts = np.empty((len(durations), 11, 49))
    known = np.zeros(len(durations), np.bool_)
    for k in range(_RATE_ROUNDS):
        bound = slack * attained
        if not bound < limit or k == _RATE_ROUNDS - 1:
            bound = limit
        failed, verdict, place = -1, BELOW, 0.0
        for i in range(len(durations)):
            if coarse[i] < bound:
                continue
            if not known[i]:
                jerk = np.empty((3, 12))
                for d in range(3):
                    jerk[d] = derivative(coefficients[i, d], 3) / durations[i]**3
                parts[i] = rate_parts(specific_force(coefficients[i], durations[i]), jerk, yaw[i], durations[i])
                known[i] = True
            verdict, place = rate_stays_below(parts[i], bound)
            if verdict != BELOW:
                failed = i
                break
        if failed < 0:
            out[4, 2] = bound
            return
        if bound == limit:
            where[4, 0], where[4, 1] = failed, place
            return
        if verdict == VIOLATED:
            attained = max(attained, rate_at(parts[failed], place))
            out[4, 3] = durations[:failed].sum() + place * durations[failed]
        else:
            slack *= 1.1
