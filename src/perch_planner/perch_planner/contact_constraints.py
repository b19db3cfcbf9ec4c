"""The linear constraints of a perch: end conditions, impact window and tube."""

from __future__ import annotations

from math import cos, pi, sin
from typing import Any

import numpy as np

from perch_core.arrays import Array, Flags, Indices
from perch_core.jit import compiled
from perch_core.vehicle import GRAVITY
from perch_planner.linear_bounds import BoundArrays
from perch_planner.problem import PerchProblem, PerchSettings

INSET = 1e-7
"""Tightening of the bounds [SI], more than the residual that usually remains (`active_set.TOLERANCE` of a row's length).
`active_set.FEASIBILITY` permits a larger residual: the certificate of the impact speed is computed from the plan itself."""

TUBE_STEP = 0.01    # dt of [M:eq15] [s]
TUBE_SHARE = 0.1    # q of [M:eq15]
TUBE_FLOOR = 0.33   # least half width of the tube per axis [m/s^2]: the printed one closes where a component of the acceleration is zero
_FACETS = 4  # the tangential speed stays inside a regular octagon
_INSCRIBED = cos(pi / (2 * _FACETS))
_NO_DERIVATIVES = (np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, 3)))  # of waypoints: their numbers, orders, values
_OCTAGON = np.array([[cos(k * pi / _FACETS), sin(k * pi / _FACETS)] for k in range(_FACETS)])


@compiled
def _bounds(durations: Array, before_end: Array, tube_lower: Array, tube_upper: Array, window: Array, window_lower: Array,
            window_upper: Array) -> BoundArrays:
    """Fields of `Bounds`: tube rows for each instant and axis, then rows of the window. Instants before the start are dropped.

    Args:
        durations: of the segments [s], shape (f,).
        before_end: instants of the tube, relative to the end [s], ascending, shape (k,).
        tube_lower, tube_upper: from `tube_bounds`, tightened, shape (3,).
        window, window_lower, window_upper: directions and bounds of the velocity at contact, shapes (w, 3), (w,), (w,).
    """
    last, end = len(durations) - 1, durations.sum()
    first = 0
    while first < len(before_end) and end + before_end[first] < -1e-12:
        first += 1
    count = len(before_end) - first
    total = 3 * count + len(window)
    owner = np.arange(total)
    segments, places, orders = np.empty(total, np.int64), np.empty(total), np.empty(total, np.int64)
    direction, lower, upper = np.zeros((total, 3)), np.empty(total), np.empty(total)
    for q in range(count):
        t, begin, i = end + before_end[first + q], 0.0, 0
        while i < last and t + 1e-12 >= begin + durations[i]:
            begin += durations[i]
            i += 1
        for d in range(3):
            r = 3 * q + d
            segments[r], places[r], orders[r] = i, min(max((t - begin) / durations[i], 0.0), 1.0), 2
            direction[r, d], lower[r], upper[r] = 1.0, tube_lower[d], tube_upper[d]
    for k in range(len(window)):
        r = 3 * count + k
        segments[r], places[r], orders[r] = last, 1.0, 1
        direction[r], lower[r], upper[r] = window[k], window_lower[k], window_upper[k]
    return owner, segments, places, orders, direction, lower, upper


@compiled
def tube_bounds(end_acceleration: Array, share: float, floor: float) -> tuple[Array, Array]:
    """Bounds on the acceleration before contact [m/s^2], two arrays of shape (3,). [defines M:eq15]

    The paper scales each component by (1 - q) and (1 + q): for a negative component that swaps the bounds, so they are
    sorted here; for a component near zero it leaves no room, so each axis has at least `TUBE_FLOOR` on both sides.
    """
    lower, upper = np.empty(3), np.empty(3)
    for d in range(3):
        near, far = (1.0 - share) * end_acceleration[d], (1.0 + share) * end_acceleration[d]
        lower[d] = min(min(near, far), end_acceleration[d] - floor)
        upper[d] = max(max(near, far), end_acceleration[d] + floor)
    return lower, upper


@compiled
def _window(R_WS: Array, velocity: Array, velocity_change: Array, least: float, most: float, tangential: float) -> tuple[Array, Array, Array]:
    """Directions and bounds of the velocity at contact: along -s3, then the facets of the octagon. [defines M:eq14]

    They hold for a contact on time and for a delayed one, after `velocity_change` [m/s], shape (3,). Where no
    velocity satisfies the bounds at both times, the change is limited to their width: the velocity of a contact on time then
    lies on the edge of its bounds that is nearest to those of the delayed one.
    """
    count = 1 + len(_OCTAGON)
    directions, lower, upper, changes = np.empty((count, 3)), np.empty(count), np.empty(count), np.zeros(count)
    for k in range(count):
        shift = 0.0
        for d in range(3):
            if k == 0:
                directions[k, d] = -R_WS[d, 2]
            else:
                directions[k, d] = _OCTAGON[k - 1, 0] * R_WS[d, 0] + _OCTAGON[k - 1, 1] * R_WS[d, 1]
            shift += directions[k, d] * velocity[d]
            changes[k] += directions[k, d] * velocity_change[d]
        lower[k] = shift + (least if k == 0 else -tangential)
        upper[k] = shift + (most if k == 0 else tangential)
    slip = np.abs(changes[1:]).max()
    for k in range(count):
        low, high, change, largest = lower[k], upper[k], changes[k], abs(changes[0]) if k == 0 else slip
        if largest > max(high - low, 0.0):
            change *= (high - low) / largest
        lower[k] = min(low - min(change, 0.0), high)
        upper[k] = max(high - max(change, 0.0), low)
    return directions, lower, upper


@compiled
def _knots(durations: Array, given: Flags, values: Array, velocity: Array) -> tuple[Flags, Array]:
    """Flags and values of the conditions at the knots; knots between the last waypoint and contact are free."""
    f, last = len(durations), len(given) - 1
    out, at = np.zeros((f + 1, 4), np.bool_), np.zeros((f + 1, 4, 3))
    for i in range(last + 1):
        to = i if i < last else f
        for k in range(4):
            out[to, k] = given[i, k]
            for d in range(3):
                at[to, k, d] = values[i, k, d]
    duration = durations.sum()
    for d in range(3):
        at[f, 0, d] += velocity[d] * duration
    return out, at


@compiled
def _bubbles(count: int, given: Flags, first_in_tube: int, everywhere: bool) -> Flags:
    """Flags of the segments with bubbles: those of the tube and those after a waypoint with all derivatives given, or all."""
    out = np.zeros(count, np.bool_)
    for i in range(count):
        out[i] = everywhere or i >= first_in_tube
    for k in range(1, len(given) - 1):
        if given[k, 0] and given[k, 1] and given[k, 2] and given[k, 3]:
            out[k] = True
    return out


@compiled
def tube_times(tube_time: float, tube_step: float) -> Array:
    """Instants -t_k + j dt, 0 <= j < t_k / dt, of the tube, relative to the contact [s]. [M:eq15]"""
    count = int(np.ceil(tube_time / tube_step - 1e-9))
    out = np.empty(count)
    for j in range(count):
        out[j] = tube_step * j - tube_time
    return out


@compiled
def _contact(points: Array, v: Array, a: Array, j: Array, places: Indices, orders: Indices, fixed: Array, R_WS: Array, velocity: Array,
             alpha: float, share: float, floor: float, tube_time: float, tube_step: float, delay: float, least: float, most: float, tangential: float
             ) -> tuple[Flags, Array, tuple[Array, Array, Array, Array, Array, Array]]:
    """Knots, tube and window of a problem, with the contact position of a static target. [defines M:eq11]

    Returns:
        (given, values, before_contact): flags and values of the conditions at start, waypoints and contact, shapes (k, 4)
        and (k, 4, 3), and arguments of `_bounds`.
    """
    acceleration, last = np.empty(3), len(points) - 1
    for d in range(3):
        acceleration[d] = alpha * R_WS[d, 2]
    acceleration[2] -= GRAVITY
    given, values = np.zeros((last + 1, 4), np.bool_), np.zeros((last + 1, 4, 3))
    given[:, 0], given[0], given[last, 2] = True, True, True
    values[:, 0] = points
    values[0, 1], values[0, 2], values[0, 3], values[last, 2] = v, a, j, acceleration
    for q in range(len(places)):
        given[places[q], orders[q]], values[places[q], orders[q]] = True, fixed[q]
    lower, upper = tube_bounds(acceleration, share, floor)
    directions, window_lower, window_upper = _window(R_WS, velocity, delay * acceleration, least, most, tangential)
    return given, values, (tube_times(tube_time, tube_step), lower + INSET, upper - INSET, directions, window_lower,
                           window_upper)


@compiled
def conditions(durations: Array, everywhere: bool, velocity: Array, problem: tuple[Any, ...]) -> tuple[Flags, Array, Flags, BoundArrays]:
    """Knots [M:eq6, M:eq11], tube [M:eq15] and window [M:eq14] for given durations.

    The contact with a moving target is at its position at the end. Where there are more durations than segments of the
    problem, the knots between the last waypoint and contact have no conditions. The approach runs along -s3, where s3 is the
    *outward* normal, so the window reads v_min <= -v(t_f) . s3 <= v_max; all velocities are relative to the surface.

    Args:
        durations: of the segments [s], shape (f,).
        everywhere: all segments have bubbles.
        velocity, problem: attributes of `Contact`.

    Returns:
        (given, values, bubbles, bounds): arguments of `reduced_qp.assemble`, and fields of `Bounds`.
    """
    given, values, before_contact = _contact(*problem)
    bounds = _bounds(durations, *before_contact)
    bubbles = _bubbles(len(durations), given, bounds[1][0], everywhere)
    given, values = _knots(durations, given, values, velocity)
    return given, values, bubbles, bounds


class Contact:
    """Data of a problem that do not depend on the durations; built once per plan.

    Attributes:
        velocity: of the target in W [m/s], shape (3,).
        points: start, waypoints, and the contact with a static target [m], shape (waypoints + 2, 3).
        problem: arguments of `_contact`.
    """

    def __init__(self, problem: PerchProblem, settings: PerchSettings, perch_offset: float) -> None:
        start, R_WS = problem.start, problem.surface.R_WS
        inset = min(INSET, 0.5 * (settings.impact_speed_max - settings.impact_speed_min))
        self.velocity = problem.target_velocity
        self.points = problem.points.copy()
        self.points[-1] += perch_offset * R_WS[:, 2]
        fixed = [(k, order, value) for k, waypoint in enumerate(problem.waypoints, start=1)
                 for order, value in ((1, waypoint.v), (2, waypoint.a), (3, waypoint.j)) if value is not None]
        derivatives = tuple(map(np.array, zip(*fixed))) if fixed else _NO_DERIVATIVES
        self.problem = (self.points, start.v, start.a, start.j, *derivatives, R_WS, self.velocity, settings.impact_acceleration,
                        TUBE_SHARE, TUBE_FLOOR, settings.tube_time, TUBE_STEP, settings.contact_delay,
                        settings.impact_speed_min + inset, settings.impact_speed_max - inset,
                        settings.tangential_speed_max * _INSCRIBED - INSET)
