"""Target of a perch, from a map of powerlines."""

from __future__ import annotations

import numpy as np

from perch_core import so3
from perch_core.covariance import largest_sigma
from perch_core.errors import PerchError
from perch_core.lines import perch_normal
from perch_core.values import PowerlineMap, seconds
from perch_core.values.limits import PLAN_LINES_MAX
from perch_control.mission.values import Goal, Target

_LINE_DISTANCE_MAX = 0.4  # a line that is farther from the goal's point is another one [m]


def mapped_target(lines: PowerlineMap, goal: Goal, p_WB: np.ndarray) -> Target | None:
    """Return the target on the mapped line that passes nearest to the goal's approximate point.

    Args:
        lines: the map.
        goal: gives the approximate point and the tilt.
        p_WB: position of the vehicle [m], shape (3,).

    Returns:
        The target, with b2 along the line and b3 leaning towards the vehicle's side, and with the nearest lines, as many as a
        plan takes; None where no line passes near, or where the nearest one is vertical.
    """
    distances = _distances(lines, goal.perch_point)
    nearest = np.argsort(distances, kind="stable").tolist()
    if not nearest or distances[nearest[0]] >= _LINE_DISTANCE_MAX:
        return None
    mapped = lines.lines[nearest[0]]
    line = mapped.segment
    point = line.closest_point(goal.perch_point)
    try:
        b3 = perch_normal(line, point, goal.perch_pitch, p_WB)
    except PerchError:
        return None
    q_WS = so3.quat_from_matrix(np.stack([np.cross(line.direction, b3), line.direction, b3], axis=1))
    return Target(seconds(lines.stamp), point, q_WS, largest_sigma(np.reshape(mapped.covariance, (3, 3))), mapped.direction_sigma,
                  lines=tuple(lines.lines[k] for k in sorted(nearest[:PLAN_LINES_MAX])), line=mapped.id)


def _distances(lines: PowerlineMap, p_W: np.ndarray) -> np.ndarray:
    """Distances of a point from the lines of a map [m], shape (n,), in one call: a map may have 500 lines."""
    ends = np.array([(line.start, line.end) for line in lines.lines], float).reshape(-1, 2, 3)
    from_start, along = p_W - ends[:, 0], ends[:, 1] - ends[:, 0]
    share = np.clip(np.sum(from_start * along, axis=1) / np.sum(along * along, axis=1), 0.0, 1.0)
    return np.linalg.norm(from_start - share[:, None] * along, axis=1)
