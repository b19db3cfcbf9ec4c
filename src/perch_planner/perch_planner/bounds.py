"""Proved bounds of polynomials in Bernstein form, by subdivision. [M:alg1 without its failures in floating point]

The smallest and largest coefficient enclose a polynomial on [0, 1]; halving the interval shrinks the enclosure with
the square of its width. Subdivision takes means only, so that rounding stays near 1e-15 of the largest coefficient.
"""

from __future__ import annotations

from math import comb

import numpy as np

from perch_core.arrays import Array
from perch_core.jit import compiled

ROUNDING = 1e-13
"""Enclosures are widened by this share of the largest coefficient."""

_BINOMIALS = np.array([[comb(n, k) for k in range(64)] for n in range(64)], float)
_DEPTH = 48
_NODES = 4000

BELOW, VIOLATED, UNDECIDED = 1, 0, -1


@compiled
def largest(values: Array) -> float:
    """The largest entry of a vector."""
    out: float = values[0]
    for k in range(1, len(values)):
        if values[k] > out:
            out = values[k]
    return out


@compiled
def smallest(values: Array) -> float:
    """The smallest entry of a vector."""
    out: float = values[0]
    for k in range(1, len(values)):
        if values[k] < out:
            out = values[k]
    return out


@compiled
def magnitude(values: Array) -> float:
    """The largest absolute value of a vector's entries."""
    out = 0.0
    for k in range(len(values)):
        out = max(out, abs(values[k]))
    return out


@compiled
def split(work: Array, left: Array) -> None:
    """De Casteljau at 1/2: the left half is written to `left`, and `work` becomes the right half.

    Four levels are computed in one pass: single-level passes stall on their own stores and take three times as long.
    """
    n, k = len(work), 0
    while k + 3 < n:
        a, b, c, d = work[0], work[1], work[2], work[3]
        left[k], left[k + 1] = a, 0.5 * (a + b)
        left[k + 2], left[k + 3] = 0.25 * (a + c) + 0.5 * b, 0.125 * (a + d) + 0.375 * (b + c)
        m = n - k - 4
        for i in range(m):
            work[i] = 0.0625 * (work[i] + work[i + 4]) + 0.25 * (work[i + 1] + work[i + 3]) + 0.375 * work[i + 2]
        a, b, c, d = work[m], work[m + 1], work[m + 2], work[m + 3]
        work[m], work[m + 1], work[m + 2] = 0.125 * (a + d) + 0.375 * (b + c), 0.25 * (b + d) + 0.5 * c, 0.5 * (c + d)
        k += 4
    while k < n:
        left[k] = work[0]
        for i in range(n - 1 - k):
            work[i] = 0.5 * (work[i] + work[i + 1])
        k += 1


@compiled
def stays_below(coefficients: Array, bound: float) -> tuple[int, float]:
    """Whether a polynomial stays below a bound on [0, 1]. [uses M:alg1]

    Args:
        coefficients: Bernstein coefficients, shape (n + 1,).
        bound: the bound.

    Returns:
        (verdict, place): BELOW: proved; VIOLATED: `place` is an argument where the value is >= bound;
        UNDECIDED: within rounding of the bound near `place`.
    """
    n = len(coefficients)
    if coefficients[0] >= bound:
        return VIOLATED, 0.0
    if coefficients[n - 1] >= bound:
        return VIOLATED, 1.0
    size, most = 0.0, -np.inf
    for k in range(n):
        size = max(size, abs(coefficients[k] - bound))
        most = max(most, coefficients[k] - bound)
    margin = ROUNDING * size
    if most < -margin:
        return BELOW, 0.0
    stack = np.empty((_DEPTH + 2, n))
    start = np.zeros(_DEPTH + 2)
    depth = np.zeros(_DEPTH + 2, np.int64)
    for k in range(n):
        stack[0, k] = coefficients[k] - bound
    top, nodes = 1, 0
    doubtful = -1.0
    while top > 0:
        top -= 1
        nodes += 1
        if largest(stack[top]) < -margin:
            continue
        if depth[top] >= _DEPTH or nodes >= _NODES:
            return UNDECIDED, start[top]
        level, begin = depth[top] + 1, start[top]
        middle = begin + 0.5**level
        split(stack[top], stack[top + 1])
        if stack[top, 0] >= 0.0:
            if stack[top, 0] > margin:
                return VIOLATED, middle
            doubtful = middle
            continue
        depth[top], start[top] = level, middle
        depth[top + 1], start[top + 1] = level, begin
        top += 2
    if doubtful >= 0.0:
        return UNDECIDED, doubtful
    return BELOW, 0.0


@compiled
def maximum(coefficients: Array, tolerance: float, floor: float) -> tuple[float, float, float]:
    """Largest value of a polynomial on [0, 1], enclosed as far as it exceeds `floor`. [defines M:alg1, by subdivision]

    Args:
        coefficients: Bernstein coefficients, shape (n + 1,).
        tolerance: required width of the enclosure, in the polynomial's unit.
        floor: values below it need not be enclosed; -inf: all values are.

    Returns:
        (attained, proved, place): a value that is attained at `place`, and a proved upper bound;
        `proved - max(attained, floor) <= tolerance` unless rounding or the limit of 4000 nodes is met first.
    """
    n = len(coefficients)
    attained, place = coefficients[0], 0.0
    if coefficients[n - 1] > attained:
        attained, place = coefficients[n - 1], 1.0
    margin = ROUNDING * magnitude(coefficients)
    highest = largest(coefficients)
    if highest <= max(attained, floor) + tolerance:
        return attained, highest + margin, place
    stack = np.empty((_DEPTH + 2, n))
    start = np.zeros(_DEPTH + 2)
    depth = np.zeros(_DEPTH + 2, np.int64)
    for k in range(n):
        stack[0, k] = coefficients[k]
    proved = attained
    top, nodes = 1, 0
    while top > 0:
        top -= 1
        nodes += 1
        highest = largest(stack[top])
        if highest <= max(attained, floor) + tolerance or depth[top] >= _DEPTH or nodes >= _NODES:
            proved = max(proved, highest)
            continue
        level, begin = depth[top] + 1, start[top]
        middle = begin + 0.5**level
        split(stack[top], stack[top + 1])
        if stack[top, 0] > attained:
            attained, place = stack[top, 0], middle
        depth[top] = depth[top + 1] = level
        start[top], start[top + 1] = middle, begin
        # The half with the larger coefficients is visited first: it raises `attained` sooner.
        if largest(stack[top]) > largest(stack[top + 1]):
            for k in range(n):
                stack[top, k], stack[top + 1, k] = stack[top + 1, k], stack[top, k]
            start[top], start[top + 1] = begin, middle
        top += 2
    return attained, max(proved, attained) + margin, place


@compiled
def bernstein_row(degree: int, s: float) -> Array:
    """Values of the Bernstein basis at s, shape (degree + 1,)."""
    row = np.zeros(degree + 1)
    row[0] = 1.0
    for k in range(1, degree + 1):
        for i in range(k, 0, -1):
            row[i] = row[i] * (1.0 - s) + row[i - 1] * s
        row[0] *= 1.0 - s
    return row


@compiled
def _scaled(a: Array) -> Array:
    """Coefficients times binomials, for which a product is a convolution."""
    n = len(a)
    out = np.empty(n)
    for i in range(n):
        out[i] = a[i] * _BINOMIALS[n - 1, i]
    return out


@compiled
def _add_product(a: Array, b: Array, sign: float, out: Array) -> None:
    """Add sign a b to `out`; all three are `_scaled`."""
    for i in range(len(a)):
        factor = sign * a[i]
        for k in range(len(b)):
            out[i + k] += factor * b[k]


@compiled
def _divide_binomials(out: Array) -> None:
    n = len(out)
    for i in range(n):
        out[i] /= _BINOMIALS[n - 1, i]


@compiled
def product(a: Array, b: Array) -> Array:
    """Bernstein coefficients of the product of two polynomials, shapes (n + 1,), (m + 1,) -> (n + m + 1,)."""
    out = np.zeros(len(a) + len(b) - 1)
    _add_product(_scaled(a), _scaled(b), 1.0, out)
    _divide_binomials(out)
    return out


@compiled
def elevated(coefficients: Array, size: int) -> Array:
    """The same polynomial with `size` coefficients."""
    out = coefficients
    while len(out) < size:
        n = len(out)
        raised = np.empty(n + 1)
        raised[0] = out[0]
        raised[n] = out[n - 1]
        for i in range(1, n):
            raised[i] = (i * out[i - 1] + (n - i) * out[i]) / n
        out = raised
    return out


@compiled
def derivative(coefficients: Array, order: int) -> Array:
    """Bernstein coefficients of the order-th derivative with respect to s, shape (n + 1,) -> (n + 1 - order,)."""
    out = coefficients.copy()
    n = len(out)
    for k in range(order):
        for i in range(n - 1 - k):
            out[i] = (n - 1 - k) * (out[i + 1] - out[i])
    return out[:n - order].copy()


@compiled
def time_derivative(coefficients: Array, order: int, duration: float) -> Array:
    """Bernstein coefficients of the order-th time derivative of a segment, shape (3, n + 1) -> (3, n + 1 - order)."""
    rows, n = coefficients.shape
    work = np.empty(n)
    out = np.empty((rows, n - order))
    for d in range(rows):
        for i in range(n):
            work[i] = coefficients[d, i]
        for k in range(order):
            factor = (n - 1 - k) / duration
            for i in range(n - 1 - k):
                work[i] = factor * (work[i + 1] - work[i])
        for i in range(n - order):
            out[d, i] = work[i]
    return out


@compiled
def squared(a: Array) -> Array:
    """Bernstein coefficients of |a|^2 for a polynomial vector, shape (3, n + 1) -> (2 n + 1,), with half the products."""
    n = a.shape[1]
    out, scaled = np.zeros(2 * n - 1), np.empty(n)
    for d in range(a.shape[0]):
        for i in range(n):
            scaled[i] = a[d, i] * _BINOMIALS[n - 1, i]
        for i in range(n):
            out[2 * i] += scaled[i] * scaled[i]
            twice = 2.0 * scaled[i]
            for k in range(i + 1, n):
                out[i + k] += twice * scaled[k]
    _divide_binomials(out)
    return out


@compiled
def cross(a: Array, b: Array) -> Array:
    """Bernstein coefficients of a x b for polynomial vectors, shapes (3, n + 1), (3, m + 1) -> (3, n + m + 1)."""
    out = np.zeros((3, a.shape[1] + b.shape[1] - 1))
    p, q = np.empty(a.shape), np.empty(b.shape)
    for d in range(3):
        p[d], q[d] = _scaled(a[d]), _scaled(b[d])
    for d in range(3):
        e, g = (d + 1) % 3, (d + 2) % 3
        _add_product(p[e], q[g], 1.0, out[d])
        _add_product(p[g], q[e], -1.0, out[d])
        _divide_binomials(out[d])
    return out


@compiled
def value(coefficients: Array, s: float) -> float:
    """Value at s by de Casteljau's algorithm."""
    work = coefficients.copy()
    for k in range(len(work) - 1, 0, -1):
        for i in range(k):
            work[i] = (1.0 - s) * work[i] + s * work[i + 1]
    return float(work[0])


@compiled
def derivatives_at(coefficients: Array, duration: float, s: float, count: int) -> Array:
    """Time derivatives 0 to count - 1 of a segment at s, shapes (3, n + 1) -> (count, 3)."""
    out = np.empty((count, 3))
    n = coefficients.shape[1]
    work = np.empty(n)
    for d in range(3):
        for i in range(n):
            work[i] = coefficients[d, i]
        for order in range(count):
            out[order, d] = value(work[:n - order], s)
            for i in range(n - 1 - order):
                work[i] = (n - 1 - order) * (work[i + 1] - work[i]) / duration
    return out
