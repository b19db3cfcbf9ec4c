"""`perch_msgs/PowerlineArray` to the place on a line that a goal means."""

from __future__ import annotations

import numpy as np
from perch_msgs.msg import PowerlineArray

from perch_core.ros.conversions import to_array, to_seconds
from perch_control.mission import Goal, Target
from perch_core.covariance import largest_sigma
from perch_core.lines import Segment
from perch_control.mission.powerline import MappedLine, powerline_target


def mapped_target(lines: PowerlineArray, goal: Goal, p_WB: np.ndarray) -> Target | None:
    """The target on the map.

    Args:
        lines: the map.
        goal: says where on it, roughly, and with which tilt.
        p_WB: where the vehicle looks from [m], shape (3,).

    Returns:
        The target, or None when no mapped line passes near the goal's point.
    """
    known = [MappedLine(m.id, to_array(m.start), to_array(m.end),
                        largest_sigma(np.reshape(m.covariance, (3, 3))), m.direction_sigma)
             for m in lines.lines]
    return powerline_target(to_seconds(lines.header.stamp), known, goal.perch_point, goal.perch_pitch, p_WB, lines.lines)


def mapped_segments(lines: PowerlineArray) -> list[Segment]:
    """The map's lines as segments in W. What is published is known, also while some other wire is not yet determined."""
    return [Segment.between(to_array(m.start), to_array(m.end), float(m.radius), m.id) for m in lines.lines]
