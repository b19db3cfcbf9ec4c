"""The mission's own moves: from hover to hover, to the search place and around it."""

from __future__ import annotations

import math

import numpy as np

from perch_core import so3
from perch_core.trajectory import FlatTrajectory, rest_to_rest
from perch_control.mission.settings import MissionSettings
from perch_control.mission.values import Goal, Mode, State, Target

LEAD = 0.04       # a move starts this long after its decision: after the mission's own latency [s]
TURN_RATE = 0.6   # mean yaw rate of a move [rad/s]

Place = tuple[np.ndarray, float]
"""Position of a hover in W [m], shape (3,), and its yaw [rad]."""


def place_of(state: State) -> Place:
    """Where the vehicle is, as a hover."""
    return np.array(state.p_WB), float(so3.yaw_of(so3.quat_to_matrix(state.q_WB)))


class Moves:
    """Where the vehicle was armed, where the last move ends, and whether it has got there."""

    def __init__(self, settings: MissionSettings) -> None:
        self.settings = settings
        self.home: Place | None = None    # where the vehicle stood when it was armed
        self.hover: Place | None = None   # where the last move ends
        self.began = 0.0                  # when the last move was decided [s]
        self.length = 0.0                 # from then to its end [s]
        self.looked = 0                   # places of the search pattern that were flown to

    def search_place(self, goal: Goal, state: State) -> Place:
        """The goal's search pose, or above the place where the vehicle stood."""
        if self.home is None:
            self.home = place_of(state)
        p, yaw = self.home
        if goal.search_position is not None:
            return goal.search_position, goal.search_yaw if goal.search_yaw is not None else yaw
        return p + np.array([0.0, 0.0, goal.takeoff_height]), yaw

    def pattern(self, goal: Goal) -> list[tuple[np.ndarray, float]]:
        """Places around the search hover (forward, left, up [m], turn [rad]).

        A pad may be out of view: the vehicle turns and rises. Lines have to be seen from different places: it moves
        up and down, and nearer, as the error of a distance grows with its square, and back. The first `mapping_legs` of these
        are flown before any plan.
        """
        rise, turn = self.settings.search_rise, math.radians(self.settings.search_yaw_deg)
        if goal.mode is not Mode.SURFACE:
            reach, near = self.settings.mapping_reach, self.settings.mapping_approach
            return [(np.array(v), 0.0) for v in ((0, 0, reach), (near, 0, reach), (near, 0, 0), (0, 0, 0), (0, reach / 2, 0))]
        return [(np.array([0.0, 0.0, rise]), 0.0), (np.zeros(3), turn), (np.zeros(3), -turn),
                (np.array([0.0, 0.0, -rise]), 0.0), (np.zeros(3), 0.0)]

    def next_look(self, goal: Goal, state: State, target: Target | None) -> Place:
        """The next place of the pattern; towards lines no nearer to the target than `mapping_standoff`."""
        pattern = self.pattern(goal)
        offset, turn = pattern[self.looked % len(pattern)]
        self.looked += 1
        p, yaw = self.search_place(goal, state)
        if goal.mode is Mode.POWERLINE and offset[0] > 0.0:
            room = 0.0 if target is None else float(np.linalg.norm(target.p_WS - p)) - self.settings.mapping_standoff
            offset = np.array([min(offset[0], max(room, 0.0)), *offset[1:]])
        return p + so3.exp(np.array([0.0, 0.0, yaw])) @ offset, yaw + turn

    def go(self, time: float, place: Place) -> FlatTrajectory:
        """A move from the present hover to another, at rest at both ends."""
        (p0, yaw0), (p, yaw) = self.hover, place
        turn = math.remainder(yaw - yaw0, 2 * math.pi)
        duration = max(1.0, float(np.linalg.norm(p - p0)) / self.settings.transit_speed, abs(turn) / TURN_RATE)
        self.hover = (np.asarray(p, float), yaw0 + turn)
        self.began, self.length = time, duration + LEAD
        return rest_to_rest(p0, p, yaw0, yaw0 + turn, duration, start_time=time + LEAD)

    def arrived(self, time: float, state: State) -> bool:
        """The last move has ended a while ago and the vehicle rests."""
        return time > self.began + self.length + self.settings.settle_time and self.slow(state)

    def dwelt(self, time: float) -> bool:
        """The vehicle has looked around from here for long enough."""
        return time - self.began > self.length + self.settings.search_dwell

    def slow(self, state: State) -> bool:
        """The vehicle hardly moves."""
        return float(np.linalg.norm(state.v_WB)) < self.settings.settle_speed
