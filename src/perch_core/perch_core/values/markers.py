"""Markers: simple shapes in `map` for RViz and Foxglove; fields as in visualization_msgs/Marker. Stamps are whole nanoseconds."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

Floats = tuple[float, ...]


class Shape(IntEnum):
    """Shape of a marker; the values of visualization_msgs/Marker."""

    ARROW = 0
    CUBE = 1
    SPHERE = 2
    CYLINDER = 3
    LINE_STRIP = 4
    LINE_LIST = 5
    TEXT = 9


@dataclass(frozen=True)
class Marker:
    """One shape at a pose in `map`; it replaces an earlier marker with the same `ns` and `id`.

    Attributes:
        shape: shape to draw.
        ns, id: identify the marker.
        colour: red, green, blue, opacity, 0 to 1.
        scale: size [m], 3 floats; the first is the width of lines, the last the height of texts.
        p, q: position [m], 3 floats, and attitude xyzw, 4 floats.
        points: of lines and arrows [m], 3 floats each.
        text: of texts.
        removed: the marker is to be deleted.
    """

    shape: Shape
    ns: str
    id: int
    colour: Floats
    scale: Floats
    p: Floats = (0.0, 0.0, 0.0)
    q: Floats = (0.0, 0.0, 0.0, 1.0)
    points: tuple[Floats, ...] = ()
    text: str = ""
    removed: bool = False


class Markers(NamedTuple):
    """Several markers of one stamp [ns]."""

    stamp: int
    markers: tuple[Marker, ...]
