"""The mission's own moves: from hover to hover, to the search place and around it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from perch_core import so3
from perch_core.trajectory import FlatTrajectory, rest_to_rest
from perch_control.admission import START_GAP
from perch_control.mission.settings import MissionSettings
from perch_control.mission.values import Goal, State, Target

LEAD = 0.04       # a move starts this long after its decision: after the mission's own latency [s]
TURN_RATE = 0.6   # mean yaw rate of a move [rad/s]

Place = tuple[np.ndarray, float]
"""Position of a hover in W [m], shape (3,), and its yaw [rad]."""
SearchPlace = tuple[np.ndarray, float]
"""A place around the search hover: forward, left, up [m], shape (3,), and a turn [rad]."""
Reach = Callable[[np.ndarray, np.ndarray], np.ndarray]


def place_of(state: State) -> Place:
    """Return the position and yaw of the vehicle as a hover."""
    return np.array(state.p_WB), float(so3.yaw_of(so3.quat_to_matrix(state.q_WB)))


class Moves:
    """Take-off place, end of the last move, and whether it has been reached; kept from goal to goal.

    Attributes:
        settings: speeds and times.
        home: place where the vehicle was last armed on the ground; if unknown, below its hover at the first goal.
        search: the goal's search pose, or the place above `home`.
        hover: end of the last move, or the vehicle's place at the start of the goal.
        wire: target of the last perch on a wire; None: the last perch was on a surface.
    """

    def __init__(self, settings: MissionSettings) -> None:
        self.settings = settings
        self.home: Place | None = None
        self.hover: Place = np.zeros(3), 0.0
        self.search = self.hover
        self.wire: Target | None = None
        self.began = 0.0                  # when the last move was decided [s]
        self.length = 0.0                 # from then to its end [s]
        self.places_visited = 0           # number of places of the search pattern that were flown to

    def begin(self, goal: Goal, state: State, on_ground: bool) -> None:
        """Start the moves of a goal from the vehicle's state: armed on the ground, or in the air."""
        p, yaw = self.hover = place_of(state)
        height = np.array([0.0, 0.0, goal.takeoff_height])
        if on_ground:
            self.home = self.hover
        elif self.home is None:
            self.home = p - height, yaw
        p, yaw = self.home
        if goal.search_position is None:
            self.search = p + height, yaw
        else:
            self.search = goal.search_position, goal.search_yaw if goal.search_yaw is not None else yaw

    def next_search_place(self, pattern: Sequence[SearchPlace], reach: Reach) -> Place:
        """The next place of a pattern around the search hover.

        Args:
            pattern: the places.
            reach: shortens an offset (forward, left, up [m]), given the search place [m].
        """
        offset, turn = pattern[self.places_visited % len(pattern)]
        self.places_visited += 1
        p, yaw = self.search
        return p + so3.exp(np.array([0.0, 0.0, yaw])) @ reach(offset, p), yaw + turn

    def go(self, time: float, place: Place) -> FlatTrajectory:
        """Return a move from the present hover to another, at rest at both ends."""
        (p0, yaw0), (p, yaw) = self.hover, place
        turn = math.remainder(yaw - yaw0, 2 * math.pi)
        duration = max(1.0, float(np.linalg.norm(p - p0)) / self.settings.transit_speed, abs(turn) / TURN_RATE)
        self.hover = (np.asarray(p, float), yaw0 + turn)
        self.began, self.length = time, duration + LEAD
        return rest_to_rest(p0, p, yaw0, yaw0 + turn, duration, start_time=time + LEAD)

    def arrived(self, time: float, state: State) -> bool:
        """Whether the last move has ended at least `settle_time` ago and the vehicle rests."""
        return self._move_finished(time) and self.slow(state)

    def missed_destination(self, time: float, state: State) -> bool:
        """Whether the last move has ended with the vehicle elsewhere: a plan from the hover would begin too far away."""
        return self._move_finished(time) and float(np.linalg.norm(state.p_WB - self.hover[0])) > START_GAP

    def _move_finished(self, time: float) -> bool:
        """Whether the last move has ended at least `settle_time` ago."""
        return time > self.began + self.length + self.settings.settle_time

    def dwell_done(self, time: float) -> bool:
        """Whether the vehicle has observed from this place for `search_dwell`."""
        return time - self.began > self.length + self.settings.search_dwell

    def slow(self, state: State) -> bool:
        """Whether the vehicle is slower than `settle_speed`."""
        return float(np.linalg.norm(state.v_WB)) < self.settings.settle_speed
