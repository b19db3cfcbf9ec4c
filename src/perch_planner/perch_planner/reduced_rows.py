"""Linear bounds as rows of the reduced program. [M:eq8 in whitened coordinates]

A functional phi of one segment, taken along a direction d, is the row d (x) (L^-1 Z' phi) of w; its value at the
unconstrained optimum is subtracted from the bounds. Rows have unit length: the tolerances of `active_set` are lengths.
"""

from __future__ import annotations

import numpy as np

from perch_core.arrays import Array
from perch_core.jit import compiled
from perch_planner.linear_bounds import BoundArrays
from perch_planner.reduced_qp import ProgramArrays, functional, index, scales
from perch_planner.reference_element import FUNCTIONS, HERMITE

Rows = tuple[Array, Array, Array]
"""Rows and their lower and upper bounds."""


@compiled
def _whiten_functional(local: Array, segment: int, first: int, spread_T: Array, centre: Array, column: Array, constant: Array) -> None:
    """Whiten a functional of a segment: factors of w to `column`, optimum value to `constant`; spread_T: `spread` transposed."""
    count = FUNCTIONS if first >= 0 else HERMITE
    for d in range(3):
        constant[d] = 0.0
    for i in range(len(column)):
        column[i] = 0.0
    for k in range(count):
        n = index(segment, k, first)
        for d in range(3):
            constant[d] += local[k] * centre[n, d]
        for i in range(len(column)):
            column[i] += local[k] * spread_T[n, i]


@compiled
def whitened(program: ProgramArrays, segment: int) -> Array:
    """Coefficients of a segment's functions: factors of w of one dimension, then constants of all three, shape (15, size + 3)."""
    durations, first, unit, spread, centre = program
    m, scale = len(spread), scales(durations[segment] / unit)
    out = np.zeros((FUNCTIONS, m + 3))
    for k in range(FUNCTIONS if first[segment] >= 0 else HERMITE):
        n = index(segment, k, first[segment])
        for i in range(m):
            out[k, i] = scale[k] * spread[i, n]
        for d in range(3):
            out[k, m + d] = scale[k] * centre[n, d]
    return out


@compiled
def normalise(rows: Array, lower: Array, upper: Array) -> None:
    """Scale rows and their bounds to unit length."""
    for r in range(len(rows)):
        row = rows[r]
        scale = 1.0 / max(np.sqrt(np.dot(row, row)), 1e-300)
        for k in range(len(row)):
            row[k] *= scale
        lower[r] *= scale
        upper[r] *= scale


@compiled
def rows_of(program: ProgramArrays, bounds: BoundArrays) -> Rows:
    """Convert fields of `Bounds` into unit rows (r, 3 size) and bounds (r,), (r,) of a program of `reduced_qp.assemble`."""
    durations, first, unit, spread, centre = program
    owner, segments, places, orders, direction, lower, upper = bounds
    m, spread_T = len(spread), spread.T.copy()
    rows, low, high = np.zeros((len(lower), 3 * m)), lower.copy(), upper.copy()
    column, constant = np.empty(m), np.empty(3)
    for q in range(len(owner)):
        i, r = segments[q], owner[q]
        if q == 0 or i != segments[q - 1] or places[q] != places[q - 1] or orders[q] != orders[q - 1]:
            _whiten_functional(functional(durations[i], unit, places[q], orders[q]), i, first[i], spread_T, centre, column, constant)
        for d in range(3):
            if direction[q, d] != 0.0:
                for k in range(m):
                    rows[r, d * m + k] += direction[q, d] * column[k]
                low[r] -= direction[q, d] * constant[d]
                high[r] -= direction[q, d] * constant[d]
    normalise(rows, low, high)
    return rows, low, high


@compiled
def put(rows: Rows, at: int, added: Rows) -> Rows:
    """Write rows behind the first `at` ones; where there is no room, into a copy with twice the room that is needed."""
    matrix, lower, upper = rows
    end = at + len(added[1])
    if end > len(lower):
        matrix, lower, upper = np.empty((2 * end, matrix.shape[1])), np.empty(2 * end), np.empty(2 * end)
        matrix[:at], lower[:at], upper[:at] = rows[0][:at], rows[1][:at], rows[2][:at]
    matrix[at:end], lower[at:end], upper[at:end] = added[0], added[1], added[2]
    return matrix, lower, upper
