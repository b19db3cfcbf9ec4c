"""From a map of powerlines to the place to perch on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from perch_core import so3
from perch_core.covariance import largest_sigma
from perch_core.values import MappedPowerline, PowerlineMap, seconds
from perch_control.mission.values import Goal, Target


@dataclass(frozen=True)
class MappedLine:
    """One segment of the map.

    Attributes:
        id: of the segment.
        start, end: end points in W [m], shape (3,).
        sigma: largest 1-sigma of its position [m].
        direction_sigma: 1-sigma of its direction [rad].
    """

    id: int
    start: np.ndarray
    end: np.ndarray
    sigma: float
    direction_sigma: float

    def closest(self, p: np.ndarray) -> np.ndarray:
        """Point of the segment nearest to p, shape (3,)."""
        along = self.end - self.start
        share = np.clip((p - self.start) @ along / (along @ along), 0.0, 1.0)
        return self.start + share * along


def perch_attitude(line: MappedLine, p: np.ndarray, p_WB: np.ndarray, pitch: float) -> np.ndarray:
    """Attitude at the perch, xyzw: b3 is tilted about the line, away from it towards the vehicle's side.

    Args:
        line: the target line.
        p: point to grip [m], shape (3,).
        p_WB: where the vehicle looks from [m], shape (3,).
        pitch: angle of b3 from the vertical, 0 to pi [rad].
    """
    along = (line.end - line.start) / np.linalg.norm(line.end - line.start)
    side = np.cross(along, [0.0, 0.0, 1.0])
    side /= np.linalg.norm(side)
    side *= np.sign(side @ (p_WB - p)) or 1.0
    up = np.cross(along, side)
    up *= np.sign(up[2])
    b3 = np.cos(pitch) * up + np.sin(pitch) * side
    return so3.quat_from_matrix(np.stack([np.cross(along, b3), along, b3], axis=1))


def powerline_target(time: float, lines: Sequence[MappedLine], perch_point: np.ndarray, perch_pitch: float,
                     p_WB: np.ndarray, raw: tuple[MappedPowerline, ...] = (), reach: float = 0.4) -> Target | None:
    """The target on the line that passes nearest to a rough point.

    Args:
        time: stamp of the map [s].
        lines: mapped segments.
        perch_point: rough place [m], shape (3,).
        perch_pitch: wanted tilt [rad].
        p_WB: position of the vehicle [m], shape (3,).
        raw: the map as the planner takes it.
        reach: farthest accepted distance between the rough point and the line [m].

    Returns:
        The target, or None when no line passes near the point.
    """
    near = [(float(np.linalg.norm(line.closest(perch_point) - perch_point)), line) for line in lines]
    near = [item for item in near if item[0] < reach]
    if not near:
        return None
    _, line = min(near, key=lambda item: item[0])
    p = line.closest(perch_point)
    return Target(time, p, perch_attitude(line, p, p_WB, perch_pitch), line.sigma, line.direction_sigma, lines=raw, line=line.id)


def mapped_target(lines: PowerlineMap, goal: Goal, p_WB: np.ndarray) -> Target | None:
    """The target on the map.

    Args:
        lines: the map.
        goal: says where on it, roughly, and with which tilt.
        p_WB: where the vehicle looks from [m], shape (3,).

    Returns:
        The target, or None when no mapped line passes near the goal's point.
    """
    known = [MappedLine(m.id, np.array(m.start), np.array(m.end), largest_sigma(np.reshape(m.covariance, (3, 3))), m.direction_sigma)
             for m in lines.lines]
    return powerline_target(seconds(lines.stamp), known, goal.perch_point, goal.perch_pitch, p_WB, lines.lines)
