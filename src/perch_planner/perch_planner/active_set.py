"""Shortest vectors within linear bounds: the quadratic program in whitened form, in one compiled kernel. [M:eq8]

    minimise |w|^2   subject to   lower <= rows @ w <= upper

The dual active-set method of Goldfarb and Idnani (1983): w is always the optimum for the active rows alone. The most violated
row is added, and active rows whose multipliers would change their sign on the way to its bound are dropped. The active rows
are L Q, with orthonormal rows of Q and L lower triangular; Gram-Schmidt with reorthogonalisation and Givens rotations update
them (Daniel, Gragg, Kaufman and Stewart, 1976). Only rows violated at one w are looked at until they all hold; then all are.

Multipliers are those of w = sum of multiplier * row: positive where the lower bound is active, negative where the upper one is.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from perch_core.arrays import Array, Flags, Indices
from perch_core.jit import compiled

TOLERANCE = 1e-9
"""Largest violation of a row of unit length that is not corrected."""
FEASIBILITY = 1e-6
"""Largest violation, of rounding alone, with which a program counts as solved."""
_NORM_MAX = TOLERANCE / float(np.finfo(float).eps)  # |w| for which the rounding of a row exceeds the tolerance
_DEPENDENT = 1e-7    # of a unit row: length of what the active rows leave of it that counts as nothing
_REPEAT_BELOW = 0.1  # an orthogonalisation that leaves less of a row is repeated
_STEPS_FACTOR = 10   # most steps, as a multiple of rows and unknowns


class Solution(NamedTuple):
    """Result of `shortest`.

    Attributes:
        w: minimiser, shape (n,); meaningless unless `solved`.
        dual: multipliers of the rows, shape (r,), with which a similar program can start.
        solved: no row is violated by more than `TOLERANCE`. Otherwise no w exists, or none is found within rounding.
    """

    w: Array
    dual: Array
    solved: bool


@compiled
def _split(Q: Array, k: int, row: Array, y: Array, z: Array, part: Array, removed: Array) -> float:
    """Split a row into y Q and a remainder z orthogonal to the first k rows of Q, and return |z|; part, removed: work arrays like y, z."""
    for i in range(k):
        y[i] = 0.0
    for i in range(len(z)):
        z[i] = row[i]
    length: float = np.sqrt(np.dot(z, z))
    if k == 0:
        return length
    active, share, before = Q[:k], part[:k], np.inf
    while _DEPENDENT < length < _REPEAT_BELOW * before:
        before = length
        np.dot(active, z, share)
        np.dot(share, active, removed)
        for i in range(len(z)):
            z[i] -= removed[i]
        for i in range(k):
            y[i] += share[i]
        length = np.sqrt(np.dot(z, z))
    return length


@compiled
def _append(Q: Array, L: Array, k: int, y: Array, z: Array, length: float) -> None:
    """Append a row split by `_split` to the k active ones."""
    for i in range(k):
        L[k, i] = y[i]
    L[k, k] = length
    for i in range(len(z)):
        Q[k, i] = z[i] / length


@compiled
def _remove(Q: Array, L: Array, k: int, q: int) -> None:
    """Remove the q-th of k active rows; rotations of neighbouring columns make L triangular again."""
    for j in range(q, k - 1):
        for i in range(j + 2):
            L[j, i] = L[j + 1, i]
    for i in range(q, k - 1):
        size = np.hypot(L[i, i], L[i, i + 1])
        c, s = L[i, i] / size, L[i, i + 1] / size
        for j in range(i, k - 1):
            L[j, i], L[j, i + 1] = c * L[j, i] + s * L[j, i + 1], c * L[j, i + 1] - s * L[j, i]
        for j in range(Q.shape[1]):
            Q[i, j], Q[i + 1, j] = c * Q[i, j] + s * Q[i + 1, j], c * Q[i + 1, j] - s * Q[i, j]


@compiled
def _solve_transposed(L: Array, k: int, r: Array) -> None:
    """Overwrite y, the first k entries of `r`, by the solution r of L' r = y."""
    for j in range(k - 1, -1, -1):
        r[j] /= L[j, j]
        for i in range(j):
            r[i] -= L[j, i] * r[j]


@compiled
def _optimum(Q: Array, L: Array, k: int, at: Array, multipliers: Array) -> Array:
    """Shortest w with the k active rows at their bounds; their multipliers are written to `multipliers`."""
    c = at[:k].copy()
    for i in range(k):
        for j in range(i):
            c[i] -= L[i, j] * c[j]
        c[i] /= L[i, i]
        multipliers[i] = c[i]
    _solve_transposed(L, k, multipliers)
    return np.dot(c, Q[:k]) if k else np.zeros(Q.shape[1])


@compiled
def _first_zero(k: int, multipliers: Array, sign: Array, rate: Array) -> tuple[float, int]:
    """Step after which the first of k multipliers has fallen to zero at rate `sign * rate`, and which one: (step, index)."""
    least, blocking = np.inf, -1
    for j in range(k):
        fall = sign[j] * rate[j]
        if fall > 0.0 and max(sign[j] * multipliers[j], 0.0) < least * fall:
            least, blocking = max(sign[j] * multipliers[j], 0.0) / fall, j
    return least, blocking


@compiled
def _drop(Q: Array, L: Array, k: int, q: int, active: Indices, at: Array, sign: Array, multipliers: Array, is_active: Flags) -> None:
    """Remove the q-th of k active rows, with its data."""
    _remove(Q, L, k, q)
    is_active[active[q]] = False
    for j in range(q, k - 1):
        active[j], at[j], sign[j], multipliers[j] = active[j + 1], at[j + 1], sign[j + 1], multipliers[j + 1]


@compiled
def _most_violated(rows: Array, lower: Array, upper: Array, w: Array, violated: Indices, beyond: Array) -> tuple[int, float, float]:
    """Row that w violates about most among those of `violated`, its side, 1 at the lower bound, and by how much; -1 where all hold.

    Args:
        beyond: violations at an earlier w, shape (r,). Those of the rows that are looked at become that of w, of the chosen one zero: most
            rows need not be looked at, where one is chosen of which at least half of its earlier violation is left.
    """
    while True:
        p, earlier = -1, TOLERANCE
        for q in violated:
            if beyond[q] > earlier:
                p, earlier = q, beyond[q]
        if p < 0:
            return -1, 0.0, 0.0
        value = np.dot(rows[p], w)
        excess = max(lower[p] - value, value - upper[p])
        if excess >= 0.5 * earlier:
            beyond[p] = 0.0
            return p, 1.0 if value < lower[p] else -1.0, excess
        beyond[p] = excess


@compiled
def shortest(rows: Array, lower: Array, upper: Array, start: Array) -> tuple[Array, Array, bool]:
    """Return the shortest w with `lower <= rows @ w <= upper`. [defines M:eq8, in whitened coordinates]

    Args:
        rows: rows of unit length, shape (r, n).
        lower, upper: bounds, infinite where there is none, shape (r,).
        start: multipliers of a similar program, of which the signs are used, shape (r,); zeros where there is none.

    Returns:
        Fields of `Solution`.
    """
    count, n = rows.shape
    most = min(count, n)
    Q, L, is_active, dual = np.empty((most, n)), np.empty((most, most)), np.zeros(count, np.bool_), np.zeros(count)
    active, at, sign, multipliers = np.empty(most, np.int64), np.empty(most), np.empty(most), np.zeros(most)
    y, z, rate, part, removed = np.empty(most), np.empty(n), np.empty(most), np.empty(most), np.empty(n)
    k = 0
    for p in range(count):
        bound = lower[p] if start[p] > 0.0 else upper[p]
        if start[p] != 0.0 and k < most and np.isfinite(bound):
            length = _split(Q, k, rows[p], y, z, part, removed)
            if length > _DEPENDENT:
                _append(Q, L, k, y, z, length)
                active[k], at[k], sign[k], is_active[p] = p, bound, np.sign(start[p]), True
                k += 1
    w = _optimum(Q, L, k, at, multipliers)
    while k > 0:
        q = int((sign[:k] * multipliers[:k]).argmin())
        if sign[q] * multipliers[q] >= 0.0:
            break
        _drop(Q, L, k, q, active, at, sign, multipliers, is_active)
        k -= 1
        w = _optimum(Q, L, k, at, multipliers)
    steps, steps_max = 0, _STEPS_FACTOR * (count + n)
    while True:
        value, steps = np.dot(rows, w), steps + 1
        beyond = np.maximum(lower - value, value - upper)
        violated = np.nonzero(~is_active & ~(beyond <= TOLERANCE))[0]
        if len(violated) == 0 or steps > steps_max:
            for j in range(k):
                dual[active[j]] = multipliers[j]
            return w, dual, len(violated) == 0 and (count == 0 or beyond.max() <= FEASIBILITY)
        while True:
            p, side, excess = _most_violated(rows, lower, upper, w, violated, beyond)
            if p < 0:
                break
            new = 0.0
            while not is_active[p]:
                length = _split(Q, k, rows[p], y, z, part, removed)
                for j in range(k):
                    rate[j] = side * y[j]
                _solve_transposed(L, k, rate)
                to_drop, blocking = _first_zero(k, multipliers, sign, rate)
                to_bound = excess / length**2 if length > _DEPENDENT else np.inf
                step, steps = min(to_drop, to_bound), steps + 1
                if blocking < 0 and not to_bound < np.inf or steps > steps_max:
                    return w, dual, False
                for j in range(k):
                    multipliers[j] -= step * rate[j]
                new += step
                if length > _DEPENDENT:
                    for i in range(n):
                        w[i] += side * step * z[i]
                    excess -= step * length**2
                if to_bound <= to_drop:
                    _append(Q, L, k, y, z, length)
                    active[k], at[k], sign[k], multipliers[k], is_active[p] = p, lower[p] if side > 0.0 else upper[p], side, side * new, True
                    k += 1
                else:
                    _drop(Q, L, k, blocking, active, at, sign, multipliers, is_active)
                    k -= 1
            if np.dot(w, w) > _NORM_MAX**2:
                return w, dual, False
        w = _optimum(Q, L, k, at, multipliers)


def least_norm(rows: Array, lower: Array, upper: Array, dual: Array | None = None) -> Solution:
    """Call `shortest`, without a start where `dual` is None."""
    return Solution(*shortest(rows, lower, upper, np.zeros(len(lower)) if dual is None else dual))
