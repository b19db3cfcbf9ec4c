"""The reduced quadratic program: exact elimination of every equality, then whitening. [M:eq4-8, M:eq11, M:eq14, M:eq15]

Unknowns of one dimension are the derivatives at the knots and the bubbles of some segments (see reference_element).
End conditions [M:eq6, M:eq11], waypoints and continuity of the first three derivatives [M:eq7] are then *values* of
unknowns; continuity of the fourth gives one dependent unknown at each inner knot. What is left, y, is free, and with
the Cholesky factor L of its cost, y = L^-T (w0 + w), the program reads

    minimise |w|^2   subject to   lower <= rows @ w <= upper,

with one w of `size` entries per dimension, stacked. `docs/planner.md` derives it line by line.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from perch_core.jit import compiled
from perch_planner.bounds import bernstein_row
from perch_planner.reference_element import BUBBLES, DEGREE, FUNCTIONS, GRAMS, HERMITE, TABLES


class ReducedProgram(NamedTuple):
    """The whitened program and what turns its solution back into coefficients.

    Attributes:
        factor: L, lower triangular, shape (size, size).
        offset: w0, the unconstrained optimum, shape (size, 3).
        basis: all unknowns from the free ones, shape (n, size).
        particular: the unknowns that are given, shape (n, 3).
        whitened: functionals in whitened coordinates, shape (size, functionals).
        constant: values of the functionals at the unconstrained optimum, shape (functionals, 3).
        time_unit: mean segment duration, in which unknowns are measured [s].
    """

    factor: np.ndarray
    offset: np.ndarray
    basis: np.ndarray
    particular: np.ndarray
    whitened: np.ndarray
    constant: np.ndarray
    time_unit: float


@compiled
def _local_scale(ratio):
    """Factors that turn knot unknowns (in time units) into derivatives on the segment's own [0, 1]."""
    scale = np.ones(FUNCTIONS)
    for k in range(HERMITE):
        scale[k] = ratio ** (k % 4)
    return scale


@compiled
def _place(bubbles, segment, knots):
    """Index of the first bubble of a segment among all unknowns, or -1."""
    if not bubbles[segment]:
        return -1
    before = 0
    for i in range(segment):
        if bubbles[i]:
            before += 1
    return 4 * knots + BUBBLES * before


@compiled
def _functional(durations, bubbles, unit, size, segment, s, order, tables):
    """Row that gives the order-th time derivative at place s of a segment from all unknowns, shape (size,)."""
    row = np.zeros(size)
    local = bernstein_row(DEGREE - order, s) @ tables[order, :DEGREE + 1 - order]
    local = local * _local_scale(durations[segment] / unit) / durations[segment] ** order
    row[4 * segment:4 * segment + HERMITE] = local[:HERMITE]
    start = _place(bubbles, segment, len(durations) + 1)
    if start >= 0:
        row[start:start + BUBBLES] = local[HERMITE:]
    return row


@compiled
def _assemble(durations, given, values, bubbles, segments, places, orders, gram, cost_order, tables):
    f = len(durations)
    unit = durations.mean()
    n = 4 * (f + 1) + BUBBLES * bubbles.sum()
    cost = np.zeros((n, n))
    for i in range(f):
        ratio = durations[i] / unit
        scale = _local_scale(ratio)
        block = gram * np.outer(scale, scale) * ratio ** (1 - 2 * cost_order)
        k, b = 4 * i, _place(bubbles, i, f + 1)
        cost[k:k + HERMITE, k:k + HERMITE] += block[:HERMITE, :HERMITE]
        if b >= 0:
            cost[b:b + BUBBLES, b:b + BUBBLES] += block[HERMITE:, HERMITE:]
            cost[k:k + HERMITE, b:b + BUBBLES] += block[:HERMITE, HERMITE:]
            cost[b:b + BUBBLES, k:k + HERMITE] += block[HERMITE:, :HERMITE]

    particular = np.zeros((n, 3))
    for i in range(f + 1):
        for k in range(4):
            if given[i, k]:
                particular[4 * i + k] = values[i, k] * unit**k

    # The dependent unknown of a knot: its highest derivative that is free, or a bubble beside it.
    role = np.ones(n, np.int64)
    for i in range(f + 1):
        for k in range(4):
            if given[i, k]:
                role[4 * i + k] = 0
    dependent = np.zeros(f - 1, np.int64)
    for i in range(1, f):
        pick = -1
        for k in range(3, 0, -1):
            if not given[i, k]:
                pick = 4 * i + k
                break
        if pick < 0:
            pick = _place(bubbles, i, f + 1)
        dependent[i - 1] = pick
        role[pick] = 2
    free = np.nonzero(role == 1)[0]
    m = len(free)
    basis = np.zeros((n, m))
    for q in range(m):
        basis[free[q], q] = 1.0
    if f > 1:
        snap = np.zeros((f - 1, n))
        for i in range(f - 1):
            snap[i] = (_functional(durations, bubbles, unit, n, i, 1.0, 4, tables)
                       - _functional(durations, bubbles, unit, n, i + 1, 0.0, 4, tables)) * unit**4
        square = np.zeros((f - 1, f - 1))
        right = np.zeros((f - 1, m + 3))
        for k in range(f - 1):
            square[:, k] = snap[:, dependent[k]]
        for q in range(m):
            right[:, q] = -snap[:, free[q]]
        right[:, m:] = -(snap @ particular)
        solved = np.linalg.solve(square, right)
        for k in range(f - 1):
            basis[dependent[k]] = solved[k, :m]
            particular[dependent[k]] = solved[k, m:]

    weighted = cost @ basis
    factor = np.linalg.cholesky(basis.T @ weighted)
    functionals = np.zeros((n, len(segments)))
    for q in range(len(segments)):
        functionals[:, q] = _functional(durations, bubbles, unit, n, segments[q], places[q], orders[q], tables)
    work = np.zeros((m, 3 + len(segments)))
    work[:, :3] = weighted.T @ particular
    work[:, 3:] = basis.T @ functionals
    for i in range(m):
        for k in range(i):
            if factor[i, k] != 0.0:
                work[i] -= factor[i, k] * work[k]
        work[i] /= factor[i, i]
    offset = -work[:, :3].copy()
    whitened = work[:, 3:].copy()
    constant = functionals.T.copy() @ particular + whitened.T.copy() @ offset
    return factor, offset, basis, particular, whitened, constant, unit


@compiled
def _further(durations, bubbles, unit, factor, offset, basis, particular, owner, segments, places, orders, direction,
             lower, upper, tables):
    """Rows of further bounds; term q adds to row owner[q]."""
    m = factor.shape[0]
    rows = np.zeros((len(lower), 3 * m))
    low, high = lower.copy(), upper.copy()
    for q in range(len(owner)):
        functional = _functional(durations, bubbles, unit, basis.shape[0], segments[q], places[q], orders[q], tables)
        column = functional @ basis
        for i in range(m):
            column[i] = (column[i] - (factor[i, :i] * column[:i]).sum()) / factor[i, i]
        constant = functional @ particular + column @ offset
        r = owner[q]
        for d in range(3):
            rows[r, d * m:(d + 1) * m] += direction[q, d] * column
            low[r] -= direction[q, d] * constant[d]
            high[r] -= direction[q, d] * constant[d]
    for r in range(len(lower)):
        norm = max(np.sqrt((rows[r] ** 2).sum()), 1e-300)
        rows[r] /= norm
        low[r] /= norm
        high[r] /= norm
    return rows, low, high


@compiled
def _constrain(whitened, constant, functional, direction, lower, upper):
    """Rows of unit length: bounds on direction . (functional of x, y, z)."""
    m = whitened.shape[0]
    count = len(functional)
    rows = np.zeros((count, 3 * m))
    low = np.empty(count)
    high = np.empty(count)
    for r in range(count):
        q = functional[r]
        value = 0.0
        for d in range(3):
            if direction[r, d] != 0.0:
                rows[r, d * m:(d + 1) * m] = direction[r, d] * whitened[:, q]
                value += direction[r, d] * constant[q, d]
        norm = np.sqrt((rows[r] ** 2).sum())
        if norm < 1e-300:
            norm = 1.0
        rows[r] /= norm
        low[r] = (lower[r] - value) / norm
        high[r] = (upper[r] - value) / norm
    return rows, low, high


@compiled
def _coefficients(factor, offset, basis, particular, unit, durations, bubbles, w, tables):
    m = factor.shape[0]
    y = offset.copy()
    for d in range(3):
        y[:, d] += w[d * m:(d + 1) * m]
    for i in range(m - 1, -1, -1):
        y[i] /= factor[i, i]
        for k in range(i):
            if factor[i, k] != 0.0:
                y[k] -= factor[i, k] * y[i]
    unknowns = particular + basis @ y
    f = len(durations)
    out = np.zeros((f, 3, DEGREE + 1))
    for i in range(f):
        local = np.zeros((FUNCTIONS, 3))
        scale = _local_scale(durations[i] / unit)
        for k in range(HERMITE):
            local[k] = unknowns[4 * i + k] * scale[k]
        start = _place(bubbles, i, f + 1)
        if start >= 0:
            local[HERMITE:] = unknowns[start:start + BUBBLES]
        out[i] = (tables[0] @ local).T
    return out


def assemble(durations: np.ndarray, given: np.ndarray, values: np.ndarray, bubbles: np.ndarray, segments: np.ndarray,
             places: np.ndarray, orders: np.ndarray, cost_order: int) -> ReducedProgram:
    """Eliminate the equalities and whiten the cost. [M:eq4-8]

    Args:
        durations: segment durations [s], shape (f,).
        given: which of position, velocity, acceleration, jerk are given at each knot, bool, shape (f + 1, 4).
        values: their values in W [m, m/s, ...], shape (f + 1, 4, 3); ignored where not given.
        bubbles: which segments have bubbles, bool, shape (f,). A segment that starts at a knot with everything given
            must have them: a bubble then serves the continuity of the fourth derivative.
        segments, places, orders: functionals that constraints use: segment index, s in [0, 1], time derivative.
        cost_order: 4 minimises snap, 3 jerk.

    Raises:
        numpy.linalg.LinAlgError: the cost is not positive definite on what is left free.
    """
    return ReducedProgram(*_assemble(durations, given, values, bubbles, segments, places, orders, GRAMS[cost_order],
                                     cost_order, TABLES))


def further_rows(program: ReducedProgram, durations: np.ndarray, bubbles: np.ndarray, owner: np.ndarray,
                 segments: np.ndarray, places: np.ndarray, orders: np.ndarray, direction: np.ndarray, lower: np.ndarray,
                 upper: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows of bounds on sums of derivatives, for a program that is assembled already.

    Args:
        program, durations, bubbles: as assembled.
        owner: row to which each term adds, shape (t,).
        segments, places, orders, direction: the terms, direction of shape (t, 3).
        lower, upper: bounds, shape (r,).

    Returns:
        rows (r, 3 size), lower (r,), upper (r,), scaled to unit length.
    """
    return _further(durations, bubbles, program.time_unit, program.factor, program.offset, program.basis,
                    program.particular, owner, segments, places, orders, direction, lower, upper, TABLES)


def constraint_rows(program: ReducedProgram, functional: np.ndarray, direction: np.ndarray, lower: np.ndarray,
                    upper: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows `lower <= direction . functional <= upper` in whitened coordinates, scaled to unit length.

    Args:
        program: the program whose functionals are meant.
        functional: index of the functional of each row, shape (r,).
        direction: direction in W of each row, shape (r, 3).
        lower, upper: bounds in the functional's unit, infinite where there is none, shape (r,).

    Returns:
        rows (r, 3 size), lower (r,), upper (r,).
    """
    return _constrain(program.whitened, program.constant, functional, direction, lower, upper)


def coefficients(program: ReducedProgram, durations: np.ndarray, bubbles: np.ndarray, w: np.ndarray) -> np.ndarray:
    """Bernstein coefficients of x, y, z of a solution `w`, shape (f, 3, 15) [m]."""
    return _coefficients(program.factor, program.offset, program.basis, program.particular, program.time_unit, durations,
                         bubbles, w, TABLES)
