"""Linear bounds on derivatives at single places of a plan, independent of the formulation of the program."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from perch_core.arrays import Array, Indices
from perch_core.jit import compiled

BoundArrays = tuple[Indices, Indices, Array, Indices, Array, Array, Array]
"""Fields of `Bounds`."""


class Bounds(NamedTuple):
    """Linear bounds at single places of the plan: lower <= sum of direction . (order-th derivative) <= upper.

    Successive terms of the same derivative at the same place are evaluated once.

    Attributes:
        owner: index of the bound to which each term adds, shape (t,).
        segments, places, orders: segment of each term, place in [0, 1] on it, and order of the time derivative, from 0
            for position to 4 for snap; each shape (t,).
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
    """Return arrays of `Bounds` to be filled in, with `terms` terms of weight zero and `rows` rows without bounds."""
    return (np.zeros(terms, np.int64), np.zeros(terms, np.int64), np.zeros(terms), np.full(terms, 2), np.zeros((terms, 3)),
            np.full(rows, -np.inf), np.full(rows, np.inf))
