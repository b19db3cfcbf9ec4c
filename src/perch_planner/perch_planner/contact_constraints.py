"""The linear constraints of a perch: end conditions, impact window and tube. [M:eq11, M:eq14, M:eq15]"""

from __future__ import annotations

from math import cos, pi, sin
from typing import NamedTuple

import numpy as np

from perch_core.jit import compiled
from perch_planner.problem import PerchProblem, PerchSettings, contact_acceleration

INSET = 1e-7
"""Bounds are tightened by this [SI], so that a solver's residual (1e-9 of a row) cannot leave the true ones."""

_FACETS = 4  # the tangential speed stays inside a regular octagon
_OCTAGON = np.array([[cos(k * pi / _FACETS), sin(k * pi / _FACETS)] for k in range(_FACETS)])


class LinearConstraints(NamedTuple):
    """Bounds on directions of functionals: `lower <= direction . d^order p/dt^order (segment, place) <= upper`.

    Attributes:
        segments, places, orders: functionals, each shape (q,).
        functional: index of the functional of each row, shape (r,).
        direction: shape (r, 3).
        lower, upper: shape (r,).
    """

    segments: np.ndarray
    places: np.ndarray
    orders: np.ndarray
    functional: np.ndarray
    direction: np.ndarray
    lower: np.ndarray
    upper: np.ndarray


@compiled
def _rows(durations, times, tube_lower, tube_upper, window, window_lower, window_upper):
    """Tube rows for each instant and axis, then the window's rows; instants before the start are dropped."""
    last = len(durations) - 1
    first = 0
    while first < len(times) and times[first] < -1e-12:
        first += 1
    count = len(times) - first
    total = 3 * count + len(window)
    segments, places, orders = np.empty(count + 1, np.int64), np.empty(count + 1), np.empty(count + 1, np.int64)
    functional, direction = np.empty(total, np.int64), np.zeros((total, 3))
    lower, upper = np.empty(total), np.empty(total)
    for q in range(count):
        t, begin, i = times[first + q], 0.0, 0
        while i < last and t + 1e-12 >= begin + durations[i]:
            begin += durations[i]
            i += 1
        segments[q], places[q], orders[q] = i, min(max((t - begin) / durations[i], 0.0), 1.0), 2
        for d in range(3):
            r = 3 * q + d
            functional[r], direction[r, d], lower[r], upper[r] = q, 1.0, tube_lower[d], tube_upper[d]
    segments[count], places[count], orders[count] = last, 1.0, 1
    for k in range(len(window)):
        r = 3 * count + k
        functional[r], lower[r], upper[r] = count, window_lower[k], window_upper[k]
        for d in range(3):
            direction[r, d] = window[k, d]
    return segments, places, orders, functional, direction, lower, upper


@compiled
def _tube(end_acceleration, share, floor):
    lower, upper = np.empty(3), np.empty(3)
    for d in range(3):
        near, far = (1.0 - share) * end_acceleration[d], (1.0 + share) * end_acceleration[d]
        lower[d] = min(min(near, far), end_acceleration[d] - floor)
        upper[d] = max(max(near, far), end_acceleration[d] + floor)
    return lower, upper


def tube_bounds(end_acceleration: np.ndarray, settings: PerchSettings) -> tuple[np.ndarray, np.ndarray]:
    """Bounds on the acceleration before contact [m/s^2], two arrays of shape (3,). [M:eq15]

    The paper scales each component by (1 - q) and (1 + q): for a negative component that swaps the bounds, so they are
    sorted here; for a component near zero it leaves no room, so each axis has at least `tube_floor` on both sides.
    """
    return _tube(end_acceleration, settings.tube_tolerance, settings.tube_floor)


@compiled
def _window(R_WS, velocity, least, most, tangential):
    """Directions and bounds of the velocity at contact: along -s3, then the facets of the octagon. [M:eq14]"""
    count = 1 + len(_OCTAGON)
    directions, lower, upper = np.empty((count, 3)), np.empty(count), np.empty(count)
    for k in range(count):
        shift = 0.0
        for d in range(3):
            if k == 0:
                directions[k, d] = -R_WS[d, 2]
            else:
                directions[k, d] = _OCTAGON[k - 1, 0] * R_WS[d, 0] + _OCTAGON[k - 1, 1] * R_WS[d, 1]
            shift += directions[k, d] * velocity[d]
        lower[k] = shift + (least if k == 0 else -tangential)
        upper[k] = shift + (most if k == 0 else tangential)
    return directions, lower, upper


@compiled
def _knots(durations, given, values, p_contact, velocity):
    """What is given at the knots; those between the last waypoint and contact are free."""
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
        at[f, 0, d] = p_contact[d] + velocity[d] * duration
    return out, at


def tube_times(duration: float, settings: PerchSettings) -> np.ndarray:
    """The instants t_f - t_k + j dt, 0 <= j < t_k / dt, of the tube [s]. [M:eq15]"""
    count = int(np.ceil(settings.tube_time / settings.tube_step - 1e-9))
    return duration - settings.tube_time + settings.tube_step * np.arange(count)


class Contact:
    """What does not change while durations are stretched; made once per plan."""

    def __init__(self, problem: PerchProblem, settings: PerchSettings, perch_offset: float) -> None:
        surface = problem.surface
        self.velocity = problem.target_velocity
        self.p_contact = surface.p_WS + perch_offset * surface.normal
        self.acceleration = contact_acceleration(surface, settings.impact_acceleration)
        knots = len(problem.waypoints) + 2
        self._given = np.zeros((knots, 4), bool)
        self._values = np.zeros((knots, 4, 3))
        start = problem.start
        self._given[0], self._values[0] = True, (start.p, start.v, start.a, start.j)
        self._complete = []  # waypoints at which everything is given
        for k, waypoint in enumerate(problem.waypoints, start=1):
            at = (waypoint.p, waypoint.v, waypoint.a, waypoint.j)
            for order, value in enumerate(at):
                if value is not None:
                    self._given[k, order], self._values[k, order] = True, value
            if all(value is not None for value in at):
                self._complete.append(k)
        self._given[-1] = (True, False, True, False)
        self._values[-1, 2] = self.acceleration

        lower, upper = tube_bounds(self.acceleration, settings)
        self._tube_lower, self._tube_upper = lower + INSET, upper - INSET
        self._tube_times = tube_times(0.0, settings)
        tangential = settings.tangential_speed_max * cos(pi / (2 * _FACETS)) - INSET
        least, most = settings.impact_speed_min + INSET, settings.impact_speed_max - INSET
        if least > most:
            least = most = 0.5 * (settings.impact_speed_min + settings.impact_speed_max)
        self._window = _window(surface.R_WS, self.velocity, least, most, tangential)

    def knots(self, durations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What is given at the knots and its values; a moving target is met where it is at the end. [M:eq6, M:eq11]

        Where there are more durations than segments of the problem, nothing is given at the knots between the last
        waypoint and contact.

        Returns:
            given, bool, shape (f + 1, 4), and values, shape (f + 1, 4, 3).
        """
        return _knots(durations, self._given, self._values, self.p_contact, self.velocity)

    def constraints(self, durations: np.ndarray) -> LinearConstraints:
        """Tube and impact window for these durations. [M:eq14, M:eq15]

        The approach runs along -s3, the *outward* normal, so [M:eq14] reads v_min <= -v(t_f) . s3 <= v_max; all
        velocities are relative to the surface.
        """
        times = float(durations.sum()) + self._tube_times
        return LinearConstraints(*_rows(durations, times, self._tube_lower, self._tube_upper, *self._window))

    def bubbles(self, durations: np.ndarray, constraints: LinearConstraints, everywhere: bool) -> np.ndarray:
        """Segments with bubbles: those of the tube, and those after a knot whose derivatives are all given."""
        if everywhere:
            return np.ones(len(durations), bool)
        out = np.zeros(len(durations), bool)
        out[constraints.segments[0]:] = True
        for k in self._complete:
            out[k] = True
        return out

