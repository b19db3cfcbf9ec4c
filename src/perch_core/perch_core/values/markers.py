"""Markers: simple shapes in `map`, as rviz and Foxglove draw them; fields as in visualization_msgs/Marker. Stamps are whole nanoseconds."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

Floats = tuple[float, ...]


class Shape(IntEnum):
    """The values of visualization_msgs/Marker."""

    ARROW = 0
    CUBE = 1
    SPHERE = 2
    CYLINDER = 3
    LINE_STRIP = 4
    LINE_LIST = 5
    TEXT = 9


@dataclass(frozen=True)
class Marker:
    """One shape at a pose in `map`; `ns` and `id` name it, so that a later one replaces it.

    Attributes:
        shape: what is drawn.
        ns, id: its name.
        colour: red, green, blue, opacity, 0 to 1.
        scale: size [m], 3 floats; of lines the width first, of texts the height last.
        p, q: position [m], 3 floats, and attitude xyzw, 4 floats.
        points: of lines and arrows [m], 3 floats each.
        text: of texts.
        removed: it is drawn no longer.
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
