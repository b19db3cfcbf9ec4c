"""The reduced quadratic program: exact elimination of every equality, then whitening. [M:eq4-8]

Unknowns of one dimension are the derivatives at the knots and the bubbles of some segments (see reference_element).
End conditions [M:eq6, M:eq11], waypoints and continuity of the first three derivatives [M:eq7] are then *values* of
unknowns; continuity of the fourth gives one dependent unknown at each inner knot. What is left, y, is free, and with
the Cholesky factor L of its cost, y = L^-T (w0 + w), the program reads

    minimise |w|^2   subject to   lower <= rows @ w <= upper,

with one w of `size` entries per dimension, stacked. `docs/planner.md` derives it line by line. Kernels are plain loops:
on matrices this small they are as fast as array expressions, and numba compiles them several times faster.
"""

from __future__ import annotations

import numpy as np

from perch_core.arrays import Array, Flags, Indices
from perch_core.jit import compiled
from perch_planner.bounds import bernstein_row
from perch_planner.reference_element import BUBBLES, DEGREE, FUNCTIONS, HERMITE, TABLES

ProgramArrays = tuple[Array, Indices, float, Array, Array]
"""A reduced program: coordinates w in which every equality holds and the cost is |w|^2: unknowns = centre + spread' w.

    durations: of the segments [s], shape (f,).
    first: index of the first bubble of each segment among all unknowns, -1 where it has none, shape (f,).
    time_unit: mean segment duration, in which unknowns are measured [s].
    spread: shape (size, n).
    centre: all unknowns at the unconstrained optimum, shape (n, 3).
"""

_POSITIONS = TABLES[0].T.copy()


@compiled
def _first_bubbles(bubbles: Flags) -> tuple[Indices, int]:
    """Index of the first bubble of each segment among all unknowns, -1 where it has none; number of unknowns."""
    out = np.empty(len(bubbles), np.int64)
    n = 4 * (len(bubbles) + 1)
    for i in range(len(bubbles)):
        out[i] = -1
        if bubbles[i]:
            out[i] = n
            n += BUBBLES
    return out, n


@compiled
def index(segment: int, k: int, first: int) -> int:
    """Index of function k of a segment among all unknowns; `first` is that of its first bubble."""
    return 4 * segment + k if k < HERMITE else first + k - HERMITE


@compiled
def scales(ratio: float) -> Array:
    """Factors that turn unknowns (in time units) into coefficients of the functions of a segment, shape (15,)."""
    out = np.ones(FUNCTIONS)
    for k in range(HERMITE):
        out[k] = ratio ** (k % 4)
    return out


@compiled
def functional(duration: float, unit: float, s: float, order: int) -> Array:
    """Factors of the segment's functions in the order-th time derivative at place s, shape (15,). [defines M:eq6]"""
    row, scale = bernstein_row(DEGREE - order, s), scales(duration / unit)
    out = np.zeros(FUNCTIONS)
    for i in range(len(row)):
        if row[i] != 0.0:
            for k in range(FUNCTIONS):
                out[k] += row[i] * TABLES[order, i, k]
    for k in range(FUNCTIONS):
        out[k] *= scale[k] / duration**order
    return out


@compiled
def _roles(given: Flags, first: Indices) -> tuple[Indices, Indices]:
    """Role of each unknown (0 given, 1 free, 2 dependent), and the dependent unknown of each inner knot.

    The dependent unknown is the highest free derivative of the knot, or else the first bubble of the segment after it.
    """
    f = len(given) - 1
    role = np.ones(4 * (f + 1) + BUBBLES * (first >= 0).sum(), np.int64)
    for i in range(f + 1):
        for k in range(4):
            if given[i, k]:
                role[4 * i + k] = 0
    dependent = np.zeros(f - 1, np.int64)
    for i in range(1, f):
        pick = first[i]
        for k in range(1, 4):
            if not given[i, k]:
                pick = 4 * i + k
        dependent[i - 1] = pick
        role[pick] = 2
    return role, dependent


@compiled
def _eliminate(durations: Array, unit: float, first: Indices, role: Indices, dependent: Indices, particular: Array) -> Array:
    """Map from free to all unknowns, shape (n, m), with continuous fourth derivative; completes `particular`. [defines M:eq7]"""
    f, n = len(durations), len(role)
    column = np.full(n, -1)
    m = 0
    for q in range(n):
        if role[q] == 1:
            column[q] = m
            m += 1
    basis = np.zeros((n, m))
    for q in range(n):
        if role[q] == 1:
            basis[q, column[q]] = 1.0
    if f == 1:
        return basis
    for k in range(f - 1):
        column[dependent[k]] = m + 3 + k
    # Rows: the jump of the fourth derivative at each inner knot; columns: free unknowns, constants, dependent unknowns.
    jump = np.zeros((f - 1, m + 2 + f))
    for i in range(f - 1):
        for side in range(2):
            segment = i + side
            local = functional(durations[segment], unit, 1.0 - side, 4)
            for k in range(FUNCTIONS if first[segment] >= 0 else HERMITE):
                q = index(segment, k, first[segment])
                change = (1.0 - 2.0 * side) * unit**4 * local[k]
                if role[q] > 0:
                    jump[i, column[q]] += change
                else:
                    for d in range(3):
                        jump[i, m + d] += change * particular[q, d]
    solved = np.linalg.solve(jump[:, m + 3:].copy(), jump[:, :m + 3].copy())
    for k in range(f - 1):
        for q in range(m):
            basis[dependent[k], q] = -solved[k, q]
        for d in range(3):
            particular[dependent[k], d] = -solved[k, m + d]
    return basis


@compiled
def _weigh(durations: Array, unit: float, first: Indices, role: Indices, basis: Array, gram: Array, cost_order: int) -> Array:
    """Cost matrix of all unknowns times the basis, segment by segment, shape (n, m). [M:eq5]"""
    n, m = basis.shape
    column = np.cumsum(role == 1) - 1
    out = np.zeros((n, m))
    for i in range(len(durations)):
        ratio = durations[i] / unit
        scale, weight = scales(ratio), ratio ** (1 - 2 * cost_order)
        count = FUNCTIONS if first[i] >= 0 else HERMITE
        for b in range(count):
            q = index(i, b, first[i])
            for a in range(count):
                share, r = gram[a, b] * scale[a] * scale[b] * weight, index(i, a, first[i])
                if share == 0.0:
                    continue
                if role[q] == 1:
                    out[r, column[q]] += share
                elif role[q] == 2:
                    for c in range(m):
                        out[r, c] += share * basis[q, c]
    return out


@compiled
def _reduced_cost(weighted: Array, basis: Array, role: Indices) -> Array:
    """Cost Z' C Z of the free unknowns, including those that depend on them, shape (m, m). [defines M:eq4]"""
    m = basis.shape[1]
    out = np.empty((m, m))
    i = 0
    for q in range(len(role)):
        if role[q] == 1:
            out[i] = weighted[q]
            i += 1
    for q in range(len(role)):
        if role[q] == 2:
            for i in range(m):
                if basis[q, i] != 0.0:
                    for c in range(m):
                        out[i, c] += basis[q, i] * weighted[q, c]
    return out


@compiled
def assemble(durations: Array, given: Flags, values: Array, bubbles: Flags, gram: Array, cost_order: int) -> ProgramArrays:
    """Eliminate the equalities and whiten the cost. [M:eq4-8]

    Args:
        durations: segment durations [s], shape (f,).
        given: which of position, velocity, acceleration, jerk are given at each knot, bool, shape (f + 1, 4).
        values: their values in W [m, m/s, ...], shape (f + 1, 4, 3); ignored where not given.
        bubbles: which segments have bubbles, bool, shape (f,). A segment that starts at a knot with everything given
            must have them: a bubble then ensures the continuity of the fourth derivative.
        gram, cost_order: of `reference_element.GRAMS`, 4 minimises snap, 3 jerk.

    Returns:
        The program, as described at `ProgramArrays`.

    Raises:
        numpy.linalg.LinAlgError: the cost is not positive definite in the free unknowns.
    """
    f = len(durations)
    unit = durations.sum() / f
    first, n = _first_bubbles(bubbles)
    particular = np.zeros((n, 3))
    for i in range(f + 1):
        for k in range(4):
            if given[i, k]:
                for d in range(3):
                    particular[4 * i + k, d] = values[i, k, d] * unit**k
    role, dependent = _roles(given, first)
    basis = _eliminate(durations, unit, first, role, dependent, particular)
    m = basis.shape[1]
    weighted = _weigh(durations, unit, first, role, basis, gram, cost_order)
    factor = np.linalg.cholesky(_reduced_cost(weighted, basis, role))

    # L^-1 applied to [Z' | g] row by row: the inner loop runs over contiguous entries.
    work = np.zeros((m, n + 3))
    for q in range(n):
        for i in range(m):
            work[i, q] = basis[q, i]
            for d in range(3):
                work[i, n + d] += weighted[q, i] * particular[q, d]
    for i in range(m):
        for k in range(i):
            if factor[i, k] != 0.0:
                for q in range(n + 3):
                    work[i, q] -= factor[i, k] * work[k, q]
        for q in range(n + 3):
            work[i, q] /= factor[i, i]
    spread = work[:, :n].copy()
    centre = particular
    for i in range(m):
        for q in range(n):
            for d in range(3):
                centre[q, d] -= spread[i, q] * work[i, n + d]
    return durations, first, unit, spread, centre


@compiled
def coefficients(program: ProgramArrays, w: Array) -> Array:
    """Bernstein coefficients of x, y, z of a solution `w`, shape (f, 3, 15) [m]; program: from `assemble`."""
    durations, first, unit, spread, centre = program
    m, n = spread.shape
    unknowns = np.empty((3, n))
    for d in range(3):
        for q in range(n):
            unknowns[d, q] = centre[q, d]
        for i in range(m):
            if w[d * m + i] != 0.0:
                for q in range(n):
                    unknowns[d, q] += w[d * m + i] * spread[i, q]
    out = np.zeros((len(durations), 3, DEGREE + 1))
    for i in range(len(durations)):
        scale = scales(durations[i] / unit)
        for d in range(3):
            for k in range(FUNCTIONS if first[i] >= 0 else HERMITE):
                share = scale[k] * unknowns[d, index(i, k, first[i])]
                for c in range(DEGREE + 1):
                    out[i, d, c] += share * _POSITIONS[k, c]
    return out
