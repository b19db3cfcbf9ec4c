"""Markers of simple shapes, in `map`."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from perch_core.values import Marker, Shape

Colour = tuple[float, float, float, float]
Floats = tuple[float, ...]
Vector = Sequence[float] | np.ndarray
_ORIGIN, _UPRIGHT = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)


def _floats(values: Iterable[float]) -> Floats:
    return tuple(float(v) for v in values)


def marker(shape: Shape, ns: str, id: int, colour: Colour, scale: Vector, p: Vector = _ORIGIN,
           q: Vector = _UPRIGHT) -> Marker:
    """A shape at a pose in `map`."""
    return Marker(shape, ns, id, colour, _floats(scale), _floats(p), _floats(q))


def polyline(ns: str, id: int, colour: Colour, width: float, points: Iterable[Vector], pieces: bool = False) -> Marker:
    """A line through points in `map` [m], or (pieces) a line between each two of them; fewer than two points remove it."""
    shape, corners = Shape.LINE_LIST if pieces else Shape.LINE_STRIP, tuple(_floats(p) for p in points)
    if len(corners) < 2:
        return removed(shape, ns, id)
    return Marker(shape, ns, id, colour, (float(width), 0.0, 0.0), points=corners)


def removed(shape: Shape, ns: str, id: int) -> Marker:
    """A marker that is drawn no longer."""
    return Marker(shape, ns, id, (0.0, 0.0, 0.0, 0.0), _ORIGIN, removed=True)


def arrow(ns: str, id: int, colour: Colour, start: Vector, end: Vector) -> Marker:
    """An arrow between two points in `map`."""
    return Marker(Shape.ARROW, ns, id, colour, (0.02, 0.05, 0.08), points=(_floats(start), _floats(end)))


def label(ns: str, id: int, colour: Colour, height: float, p: Vector, text: str) -> Marker:
    """A text that always faces the viewer; its letters are `height` high [m]."""
    return Marker(Shape.TEXT, ns, id, colour, (0.0, 0.0, height), _floats(p), text=text)


def box_edges(low: np.ndarray, high: np.ndarray) -> list[np.ndarray]:
    """End points of the twelve edges of a box, for a line of pieces."""
    corners = np.array(np.meshgrid(*zip(low, high), indexing="ij")).reshape(3, 8).T
    pairs = [(a, b) for a in range(8) for b in range(a) if np.count_nonzero(corners[a] != corners[b]) == 1]
    return [corners[k] for pair in pairs for k in pair]
