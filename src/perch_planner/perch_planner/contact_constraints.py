"""The linear constraints of a perch: end conditions, impact window and tube. [M:eq11, M:eq14, M:eq15]"""

from __future__ import annotations

from math import cos, pi, sin
from typing import NamedTuple

import numpy as np

from perch_planner.compilation import compiled
from perch_planner.problem import PerchProblem, PerchSettings, contact_acceleration

INSET = 1e-7
"""Bounds are tightened by this [SI], so that a solver's residual (1e-9 of a row) cannot leave the true ones."""

_FACETS = 4  # the tangential speed stays inside a regular octagon


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
def _locate(durations, times):
    """Segment and place of each time; times before the start are dropped."""
    segments = np.empty(len(times), np.int64)
    places = np.empty(len(times))
    count = 0
    for t in times:
        if t < -1e-12:
            continue
        begin, i = 0.0, 0
        while i < len(durations) - 1 and t + 1e-12 >= begin + durations[i]:
            begin += durations[i]
            i += 1
        segments[count] = i
        places[count] = min(max((t - begin) / durations[i], 0.0), 1.0)
        count += 1
    return segments[:count], places[:count]


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
        self.settings, self.velocity = settings, problem.target_velocity
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
        count = len(tube_times(0.0, settings))
        s1, s2, s3 = surface.R_WS.T
        tangential = settings.tangential_speed_max * cos(pi / (2 * _FACETS)) - INSET
        window = [-s3, *(cos(k * pi / _FACETS) * s1 + sin(k * pi / _FACETS) * s2 for k in range(_FACETS))]
        least = [settings.impact_speed_min + INSET] + [-tangential] * _FACETS
        most = [settings.impact_speed_max - INSET] + [tangential] * _FACETS
        self._window = np.array(window)
        shift = self._window @ self.velocity
        if least[0] > most[0]:
            least[0] = most[0] = 0.5 * (settings.impact_speed_min + settings.impact_speed_max)
        self._window_lower, self._window_upper = np.array(least) + shift, np.array(most) + shift
        self._tube_direction = np.tile(np.eye(3), (count, 1))
        self._tube_lower, self._tube_upper = np.tile(lower + INSET, count), np.tile(upper - INSET, count)

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
        segments, places = _locate(durations, tube_times(float(durations.sum()), self.settings))
        count = len(segments)
        skipped = len(self._tube_lower) // 3 - count
        return LinearConstraints(
            segments=np.append(segments, len(durations) - 1),
            places=np.append(places, 1.0),
            orders=np.append(np.full(count, 2), 1),
            functional=np.concatenate([np.repeat(np.arange(count), 3), np.full(len(self._window), count)]),
            direction=np.concatenate([self._tube_direction[3 * skipped:], self._window]),
            lower=np.concatenate([self._tube_lower[3 * skipped:], self._window_lower]),
            upper=np.concatenate([self._tube_upper[3 * skipped:], self._window_upper]),
        )

    def bubbles(self, durations: np.ndarray, constraints: LinearConstraints, everywhere: bool) -> np.ndarray:
        """Segments with bubbles: those of the tube, and those after a knot whose derivatives are all given."""
        if everywhere:
            return np.ones(len(durations), bool)
        out = np.arange(len(durations)) >= constraints.segments.min()
        out[1:len(self._given) - 1] |= self._given[1:-1].all(axis=1)
        return out

