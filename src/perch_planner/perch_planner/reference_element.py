"""The reference segment on s in [0, 1]: 8 Hermite functions of degree 7 and 7 bubbles of degree 8 to 14.

A segment is the sum of 15 functions, together all polynomials of degree 14 [M:eq3, N = 14]:

* Hermite functions 0-3 and 4-7 carry position, velocity, acceleration and jerk at s = 0 and s = 1;
* bubble m is the 4-fold integral of the normalised Legendre polynomial P_(4+m): it vanishes with three derivatives at
  both ends, and its fourth derivatives are orthonormal to each other and orthogonal to those of the Hermite functions.

So waypoints and end conditions are values of single unknowns instead of rows of a matrix, and the snap cost of the
bubbles is the unit matrix. All tables are made in rational arithmetic and rounded once.
"""

from __future__ import annotations

from fractions import Fraction
from math import comb, factorial, sqrt

import numpy as np

from perch_core import bernstein

DEGREE = 14
HERMITE = 8
BUBBLES = DEGREE - 7
FUNCTIONS = HERMITE + BUBBLES
MAX_ORDER = 4


def _integrate(powers: list[Fraction]) -> list[Fraction]:
    return [Fraction(0), *(c / (k + 1) for k, c in enumerate(powers))]


def _to_bernstein(powers: list[Fraction], degree: int) -> list[Fraction]:
    return [sum((Fraction(comb(i, k), comb(degree, k)) * powers[k] for k in range(min(i, len(powers) - 1) + 1)), Fraction(0))
            for i in range(degree + 1)]


def _hermite_powers() -> list[list[Fraction]]:
    """Powers of s of the Hermite functions, by Gauss-Jordan elimination on rationals."""
    n = HERMITE
    rows = []
    for order in range(4):
        rows.append([Fraction(factorial(order) if k == order else 0) for k in range(n)])
    for order in range(4):
        rows.append([Fraction(factorial(k), factorial(k - order)) if k >= order else Fraction(0) for k in range(n)])
    table = [row + [Fraction(int(i == k)) for k in range(n)] for i, row in enumerate(rows)]
    for column in range(n):
        pivot = next(i for i in range(column, n) if table[i][column] != 0)
        table[column], table[pivot] = table[pivot], table[column]
        scale = table[column][column]
        table[column] = [v / scale for v in table[column]]
        for i in range(n):
            if i != column and table[i][column] != 0:
                factor = table[i][column]
                table[i] = [a - factor * b for a, b in zip(table[i], table[column])]
    return [[table[k][n + f] for k in range(n)] for f in range(n)]


def _bubble_powers(m: int) -> list[Fraction]:
    """Powers of s of bubble m without its factor sqrt(2 m + 9), which is not rational."""
    k = m + 4
    powers = [Fraction((-1) ** (k + i) * comb(k, i) * comb(k + i, i)) for i in range(k + 1)]
    for _ in range(4):
        powers = _integrate(powers)
    return powers


def _position_table() -> np.ndarray:
    columns = [[float(c) for c in _to_bernstein(powers, DEGREE)] for powers in _hermite_powers()]
    for m in range(BUBBLES):
        factor = sqrt(2 * (m + 4) + 1)
        columns.append([factor * float(c) for c in _to_bernstein(_bubble_powers(m), DEGREE)])
    return np.array(columns).T.copy()


def _derivative_tables(positions: np.ndarray) -> np.ndarray:
    """Tables of all orders in one array, rows beyond degree - order are zero."""
    out = np.zeros((MAX_ORDER + 1, DEGREE + 1, FUNCTIONS))
    for order in range(MAX_ORDER + 1):
        out[order, :DEGREE + 1 - order] = bernstein.derivative(positions.T, order).T
    return out


def _gram(order: int) -> np.ndarray:
    """Integrals over [0, 1] of products of the order-th derivatives: the cost matrix of a segment of 1 s. [defines M:eq5]"""
    n = DEGREE - order
    table = TABLES[order, :n + 1]
    binomials = bernstein.binomials(n)
    index = np.arange(n + 1)
    mass = np.outer(binomials, binomials) / bernstein.binomials(2 * n)[index[:, None] + index] / (2 * n + 1)
    gram = table.T @ mass @ table
    symmetric: np.ndarray = 0.5 * (gram + gram.T)
    return symmetric


TABLES = _derivative_tables(_position_table())
"""Bernstein coefficients (degree 14 - order) of the derivatives of the 15 functions, shape (5, 15, 15)."""

GRAMS = {3: _gram(3), 4: _gram(4)}
"""Jerk (3) and snap (4) cost of the reference segment, shape (15, 15)."""

for _table in (TABLES, *GRAMS.values()):
    _table.setflags(write=False)
