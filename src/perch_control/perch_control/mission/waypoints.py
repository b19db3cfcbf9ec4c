"""The reference of an inspection: straight lines between waypoints. [P:VI-A]"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from perch_control.mission.moves import TURN_RATE, Place
from perch_core.trajectory import FlatTrajectory, rest_to_rest

_LEG_DURATION_MIN = 1.0  # duration of the shortest leg [s]


def waypoint_lines(places: Sequence[Place], speed: float, start_time: float = 0.0) -> FlatTrajectory:
    """Straight lines from place to place, at rest at each, turning the shorter way.

    Obstacles are not considered here; powerlines are avoided by the controller's line terms.

    Args:
        places: positions in W [m], shape (3,), and yaws [rad]; at least two.
        speed: mean speed of a leg [m/s].
        start_time: stamp of the start [s].
    """
    durations, coefficients = [], []
    yaw = places[0][1]
    for (p0, _), (p1, yaw1) in zip(places, places[1:], strict=False):
        turn = math.remainder(yaw1 - yaw, 2 * math.pi)
        duration = max(_LEG_DURATION_MIN, float(np.linalg.norm(np.subtract(p1, p0))) / speed, abs(turn) / TURN_RATE)
        leg = rest_to_rest(p0, p1, yaw, yaw + turn, duration)
        durations.append(duration)
        coefficients.append(leg.coefficients[0])
        yaw += turn
    return FlatTrajectory(np.array(durations), np.array(coefficients), start_time)
