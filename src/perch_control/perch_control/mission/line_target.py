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
    segments = [mapped.segment for mapped in lines.lines]
    near = [(float(line.distance(goal.perch_point)), k) for k, line in enumerate(segments)]
    if not near or min(near)[0] >= _LINE_DISTANCE_MAX:
        return None
    chosen = min(near)[1]
    mapped, line = lines.lines[chosen], segments[chosen]
    point = line.closest_point(goal.perch_point)
    try:
        b3 = perch_normal(line, point, goal.perch_pitch, p_WB)
    except PerchError:
        return None
    q_WS = so3.quat_from_matrix(np.stack([np.cross(line.direction, b3), line.direction, b3], axis=1))
    return Target(seconds(lines.stamp), point, q_WS, largest_sigma(np.reshape(mapped.covariance, (3, 3))), mapped.direction_sigma,
                  lines=tuple(lines.lines[k] for k in sorted(k for _, k in sorted(near)[:PLAN_LINES_MAX])), line=mapped.id)
