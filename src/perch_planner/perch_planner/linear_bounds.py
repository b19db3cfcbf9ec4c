"""Linear bounds on derivatives at single places of a plan: what every formulation of the program understands."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from perch_core.arrays import Array, Indices
from perch_core.jit import compiled

BoundArrays = tuple[Indices, Indices, Array, Indices, Array, Array, Array]
"""Fields of `Bounds`."""


class Bounds(NamedTuple):
    """Linear bounds at single places of the plan: lower <= sum of direction . (order-th derivative) <= upper.

    Terms of one derivative at one place that follow each other are computed once.

    Attributes:
        owner: bound to which each term adds, shape (t,).
        segments, places, orders: where a term is taken, place in [0, 1] of the segment, and its time derivative, 0
            position to 4 snap; each shape (t,).
        direction: vector in W of each term, shape (t, 3).
        lower, upper: bounds of the sums, infinite where there is none, shape (r,).
    """

    owner: Indices
    segments: Indices
    places: Array
    orders: Indices
    direction: Array
    lower: Array
    upper: Array


@compiled
def no_bounds(terms: int, rows: int) -> BoundArrays:
    """Arrays of `Bounds` to be filled in: so many terms of weight zero, so many rows without bounds."""
    return (np.zeros(terms, np.int64), np.zeros(terms, np.int64), np.zeros(terms), np.full(terms, 2), np.zeros((terms, 3)),
            np.full(rows, -np.inf), np.full(rows, np.inf))
