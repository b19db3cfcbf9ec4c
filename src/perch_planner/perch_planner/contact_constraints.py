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
        direction[r] = window[k]
    return segments, places, orders, functional, direction, lower, upper


def tube_bounds(end_acceleration: np.ndarray, settings: PerchSettings) -> tuple[np.ndarray, np.ndarray]:
    """Bounds on the acceleration before contact [m/s^2], two arrays of shape (3,). [M:eq15]

    The paper scales each component by (1 - q) and (1 + q): for a negative component that swaps the bounds, so they are
    sorted here; for a component near zero it leaves no room, so each axis has at least `tube_floor` on both sides.
    """
    q = settings.tube_tolerance
    near, far = (1.0 - q) * end_acceleration, (1.0 + q) * end_acceleration
    lower = np.minimum(np.minimum(near, far), end_acceleration - settings.tube_floor)
    upper = np.maximum(np.maximum(near, far), end_acceleration + settings.tube_floor)
    return lower, upper


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
        for k, waypoint in enumerate(problem.waypoints, start=1):
            for order, value in enumerate((waypoint.p, waypoint.v, waypoint.a, waypoint.j)):
                if value is not None:
                    self._given[k, order], self._values[k, order] = True, value
        self._given[-1] = (True, False, True, False)
        self._values[-1, 2] = self.acceleration

        lower, upper = tube_bounds(self.acceleration, settings)
        self._tube_lower, self._tube_upper = lower + INSET, upper - INSET
        self._tube_times = tube_times(0.0, settings)
        self._window = np.concatenate([-surface.normal[None], _OCTAGON @ surface.R_WS[:, :2].T])
        tangential = settings.tangential_speed_max * cos(pi / (2 * _FACETS)) - INSET
        least, most = settings.impact_speed_min + INSET, settings.impact_speed_max - INSET
        if least > most:
            least = most = 0.5 * (settings.impact_speed_min + settings.impact_speed_max)
        shift = self._window @ self.velocity
        self._window_lower = np.array([least] + _FACETS * [-tangential]) + shift
        self._window_upper = np.array([most] + _FACETS * [tangential]) + shift

    def knots(self, durations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What is given at the knots and its values; a moving target is met where it is at the end. [M:eq6, M:eq11]

        Where there are more durations than segments of the problem, nothing is given at the knots between the last
        waypoint and contact.
        """
        extra = len(durations) + 1 - len(self._given)
        given = np.zeros((len(durations) + 1, 4), bool)
        values = np.zeros((len(durations) + 1, 4, 3))
        last = len(self._given) - 1
        given[:last], given[last + extra] = self._given[:last], self._given[last]
        values[:last], values[last + extra] = self._values[:last], self._values[last]
        values[-1, 0] = self.p_contact + self.velocity * durations.sum()
        return given, values

    def constraints(self, durations: np.ndarray) -> LinearConstraints:
        """Tube and impact window for these durations. [M:eq14, M:eq15]

        The approach runs along -s3, the *outward* normal, so [M:eq14] reads v_min <= -v(t_f) . s3 <= v_max; all
        velocities are relative to the surface.
        """
        times = float(durations.sum()) + self._tube_times
        return LinearConstraints(*_rows(durations, times, self._tube_lower, self._tube_upper, self._window,
                                        self._window_lower, self._window_upper))

    def bubbles(self, durations: np.ndarray, constraints: LinearConstraints, everywhere: bool) -> np.ndarray:
        """Segments with bubbles: those of the tube, and those after a knot whose derivatives are all given."""
        if everywhere:
            return np.ones(len(durations), bool)
        out = np.arange(len(durations)) >= constraints.segments.min()
        out[1:len(self._given) - 1] |= self._given[1:-1].all(axis=1)
        return out

