"""Proved bounds of polynomials in Bernstein form, by subdivision. [M:alg1 without its failures in floating point]

The smallest and largest coefficient enclose a polynomial on [0, 1]; halving the interval shrinks the enclosure with
the square of its width. Subdivision takes means only, so that rounding stays near 1e-15 of the largest coefficient.
"""

from __future__ import annotations

from math import comb

import numpy as np

from perch_core.jit import compiled

ROUNDING = 1e-13
"""Enclosures are widened by this share of the largest coefficient."""

_BINOMIALS = np.array([[comb(n, k) for k in range(64)] for n in range(64)], float)
_DEPTH = 48
_NODES = 4000

BELOW, VIOLATED, UNDECIDED = 1, 0, -1


@compiled
def split(work, left, right):
    """De Casteljau at 1/2; `work` is used up, and its first entry is the value at the middle."""
    last = len(work) - 1
    for k in range(last + 1):
        left[k] = work[0]
        right[last - k] = work[last - k]
        for i in range(last - k):
            work[i] = 0.5 * (work[i] + work[i + 1])


@compiled
def stays_below(coefficients, bound):
    """Whether a polynomial stays below a bound on [0, 1]. [M:alg1, decided by subdivision]

    Args:
        coefficients: Bernstein coefficients, shape (n + 1,).
        bound: the bound.

    Returns:
        (verdict, place): BELOW: proved; VIOLATED: `place` is an argument where the value is >= bound;
        UNDECIDED: within rounding of the bound near `place`.
    """
    n = len(coefficients)
    size = np.abs(coefficients - bound).max()
    margin = ROUNDING * size
    stack = np.empty((_DEPTH + 2, n))
    start = np.zeros(_DEPTH + 2)
    depth = np.zeros(_DEPTH + 2, np.int64)
    stack[0] = coefficients - bound
    if stack[0, 0] >= 0.0:
        return VIOLATED, 0.0
    if stack[0, n - 1] >= 0.0:
        return VIOLATED, 1.0
    top, nodes = 1, 0
    left = np.empty(n)
    right = np.empty(n)
    doubtful = -1.0
    while top > 0:
        top -= 1
        nodes += 1
        if stack[top].max() < -margin:
            continue
        if depth[top] >= _DEPTH or nodes >= _NODES:
            return UNDECIDED, start[top]
        level, begin = depth[top] + 1, start[top]
        middle = begin + 0.5**level
        split(stack[top].copy(), left, right)
        if right[0] >= 0.0:
            if right[0] > margin:
                return VIOLATED, middle
            doubtful = middle
            continue
        stack[top], depth[top], start[top] = right, level, middle
        stack[top + 1], depth[top + 1], start[top + 1] = left, level, begin
        top += 2
    if doubtful >= 0.0:
        return UNDECIDED, doubtful
    return BELOW, 0.0


@compiled
def maximum(coefficients, tolerance):
    """Largest value of a polynomial on [0, 1], enclosed.

    Args:
        coefficients: Bernstein coefficients, shape (n + 1,).
        tolerance: wanted width of the enclosure, in the polynomial's unit.

    Returns:
        (attained, proved, place): a value that is attained at `place`, and a proved upper bound;
        `proved - attained <= tolerance` unless rounding or the limit of 4000 nodes is met first.
    """
    n = len(coefficients)
    margin = ROUNDING * np.abs(coefficients).max()
    stack = np.empty((_DEPTH + 2, n))
    start = np.zeros(_DEPTH + 2)
    depth = np.zeros(_DEPTH + 2, np.int64)
    stack[0] = coefficients
    attained, place = coefficients[0], 0.0
    if coefficients[n - 1] > attained:
        attained, place = coefficients[n - 1], 1.0
    proved = attained
    top, nodes = 1, 0
    left = np.empty(n)
    right = np.empty(n)
    while top > 0:
        top -= 1
        nodes += 1
        highest = stack[top].max()
        if highest <= attained + tolerance or depth[top] >= _DEPTH or nodes >= _NODES:
            if highest > proved:
                proved = highest
            continue
        level, begin = depth[top] + 1, start[top]
        middle = begin + 0.5**level
        split(stack[top].copy(), left, right)
        if right[0] > attained:
            attained, place = right[0], middle
        # The half with the larger coefficients is looked at first: it raises `attained` sooner.
        if left.max() > right.max():
            stack[top], start[top] = right, middle
            stack[top + 1], start[top + 1] = left, begin
        else:
            stack[top], start[top] = left, begin
            stack[top + 1], start[top + 1] = right, middle
        depth[top] = depth[top + 1] = level
        top += 2
    return attained, max(proved, attained) + margin, place


@compiled
def bernstein_row(degree, s):
    """Values of the Bernstein basis at s, shape (degree + 1,)."""
    row = np.zeros(degree + 1)
    row[0] = 1.0
    for k in range(1, degree + 1):
        for i in range(k, 0, -1):
            row[i] = row[i] * (1.0 - s) + row[i - 1] * s
        row[0] *= 1.0 - s
    return row


@compiled
def product(a, b):
    """Bernstein coefficients of the product of two polynomials, shapes (n + 1,), (m + 1,) -> (n + m + 1,)."""
    n, m = len(a), len(b)
    scaled = b * _BINOMIALS[m - 1, :m]
    out = np.zeros(n + m - 1)
    for i in range(n):
        out[i:i + m] += a[i] * _BINOMIALS[n - 1, i] * scaled
    return out / _BINOMIALS[n + m - 2, :n + m - 1]


@compiled
def derivative(coefficients, order):
    """Bernstein coefficients of the order-th derivative with respect to s, shape (n + 1,) -> (n + 1 - order,)."""
    out = coefficients.copy()
    for _ in range(order):
        out = (len(out) - 1) * (out[1:] - out[:-1])
    return out


@compiled
def dot(a, b):
    """Bernstein coefficients of a . b for polynomial vectors, shapes (3, n + 1), (3, m + 1)."""
    return product(a[0], b[0]) + product(a[1], b[1]) + product(a[2], b[2])


@compiled
def cross(a, b):
    """Bernstein coefficients of a x b for polynomial vectors, shapes (3, n + 1), (3, m + 1) -> (3, n + m + 1)."""
    out = np.empty((3, a.shape[1] + b.shape[1] - 1))
    out[0] = product(a[1], b[2]) - product(a[2], b[1])
    out[1] = product(a[2], b[0]) - product(a[0], b[2])
    out[2] = product(a[0], b[1]) - product(a[1], b[0])
    return out


@compiled
def value(coefficients, s):
    """Value at s by de Casteljau's algorithm."""
    work = coefficients.copy()
    for k in range(len(work) - 1, 0, -1):
        for i in range(k):
            work[i] = (1.0 - s) * work[i] + s * work[i + 1]
    return work[0]


@compiled
def derivatives_at(coefficients, duration, s, count):
    """Time derivatives 0 to count - 1 of a segment at s, shapes (3, n + 1) -> (count, 3)."""
    out = np.empty((count, 3))
    for d in range(3):
        work = coefficients[d].copy()
        for order in range(count):
            out[order, d] = value(work, s)
            work = (len(work) - 1) * (work[1:] - work[:-1]) / duration
    return out
