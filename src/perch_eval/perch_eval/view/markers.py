"""Markers (visualization_msgs) of simple shapes, in `map`."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker

from perch_core.ros.conversions import to_pose

Colour = tuple[float, float, float, float]
_ORIGIN, _UPRIGHT = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)


def marker(kind: int, ns: str, id: int, colour: Colour, scale: Sequence[float], p: Sequence[float] = _ORIGIN,
           q: Sequence[float] = _UPRIGHT) -> Marker:
    """A marker of a type at a pose in `map`; `ns` and `id` name it, so that a later one replaces it."""
    out = Marker(type=kind, ns=ns, id=id, action=Marker.ADD, pose=to_pose(p, q))
    out.header.frame_id = "map"
    out.color = ColorRGBA(**dict(zip("rgba", map(float, colour))))
    out.scale.x, out.scale.y, out.scale.z = map(float, scale)
    return out


def polyline(ns: str, id: int, colour: Colour, width: float, points: Iterable[Sequence[float]], pieces: bool = False) -> Marker:
    """A line through points in `map` [m], or (pieces) a line between each two of them; fewer than two points remove it."""
    out = marker(Marker.LINE_LIST if pieces else Marker.LINE_STRIP, ns, id, colour, (width, 0.0, 0.0))
    out.points = [Point(x=float(x), y=float(y), z=float(z)) for x, y, z in points]
    if len(out.points) < 2:
        out.action, out.points = Marker.DELETE, []
    return out


def arrow(ns: str, id: int, colour: Colour, start: Sequence[float], end: Sequence[float]) -> Marker:
    """An arrow between two points in `map`."""
    out = marker(Marker.ARROW, ns, id, colour, (0.02, 0.05, 0.08))
    out.points = [Point(x=float(p[0]), y=float(p[1]), z=float(p[2])) for p in (start, end)]
    return out


def label(ns: str, id: int, colour: Colour, height: float, p: Sequence[float], text: str) -> Marker:
    """A text that always faces the viewer; its letters are `height` high [m]."""
    out = marker(Marker.TEXT_VIEW_FACING, ns, id, colour, (0.0, 0.0, height), p)
    out.text = text
    return out


def box_edges(low: np.ndarray, high: np.ndarray) -> list[np.ndarray]:
    """End points of the twelve edges of a box, for a line of pieces."""
    corners = np.array(np.meshgrid(*zip(low, high), indexing="ij")).reshape(3, 8).T
    pairs = [(a, b) for a in range(8) for b in range(a) if np.count_nonzero(corners[a] != corners[b]) == 1]
    return [corners[k] for pair in pairs for k in pair]


def stamped(markers: list[Marker], stamp: Time) -> list[Marker]:
    """The same markers with a stamp."""
    for item in markers:
        item.header.stamp = stamp
    return markers
