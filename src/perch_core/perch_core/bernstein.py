"""Polynomials in Bernstein form on [0, 1]: value(s) = sum_i c_i B_i^n(s), B_i^n(s) = C(n, i) s^i (1 - s)^(n - i).

Coefficients are on the last axis (degree + 1 of them); leading axes hold any number of polynomials. The form is
well conditioned, and all values lie between the smallest and the largest coefficient, which proves bounds.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from math import comb

import numpy as np

from perch_core.arrays import Array
from perch_core.jit import compiled


@lru_cache(maxsize=None)
def binomials(n: int) -> Array:
    """Row n of Pascal's triangle, shape (n + 1,), read-only."""
    row = np.array([comb(n, i) for i in range(n + 1)], float)
    row.setflags(write=False)
    return row


def basis(degree: int, s: Array | Sequence[float] | float) -> Array:
    """Values of the basis polynomials of one degree.

    Args:
        degree: degree n of the basis.
        s: arguments in [0, 1], any shape.

    Returns:
        Array of shape `s.shape + (degree + 1,)`.
    """
    s = np.asarray(s, float)[..., None]
    i = np.arange(degree + 1)
    return binomials(degree) * s**i * (1.0 - s) ** (degree - i)


@compiled
def values_at(coefficients: Array, choose: Array, s: float) -> Array:
    """Values of several polynomials of one degree at one argument, in one pass.

    Args:
        coefficients: shape (rows, columns, degree + 1).
        choose: `binomials(degree)`.
        s: argument in [0, 1].

    Returns:
        Array of shape (rows, columns).
    """
    degree = len(choose) - 1
    weights = np.empty(degree + 1)
    power = 1.0
    for i in range(degree + 1):
        weights[i] = choose[i] * power
        power *= s
    power = 1.0
    for i in range(degree, -1, -1):
        weights[i] *= power
        power *= 1.0 - s
    out: Array = np.zeros(coefficients.shape[:2])
    for row in range(out.shape[0]):
        for column in range(out.shape[1]):
            for i in range(degree + 1):
                out[row, column] += coefficients[row, column, i] * weights[i]
    return out


def evaluate(coefficients: Array, s: Array | float) -> Array:
    """Evaluate polynomials at arguments s.

    Args:
        coefficients: shape (..., degree + 1).
        s: arguments in [0, 1], any shape.

    Returns:
        Array of shape `coefficients.shape[:-1] + s.shape`.
    """
    coefficients = np.asarray(coefficients, float)
    return np.tensordot(coefficients, basis(coefficients.shape[-1] - 1, s), axes=(-1, -1))


def derivative(coefficients: Array, order: int = 1) -> Array:
    """Coefficients of the derivative with respect to s, shape (..., max(degree - order, 0) + 1)."""
    coefficients = np.asarray(coefficients, float)
    for _ in range(order):
        degree = coefficients.shape[-1] - 1
        if degree == 0:
            return np.zeros_like(coefficients)
        coefficients = degree * np.diff(coefficients, axis=-1)
    return coefficients


@lru_cache(maxsize=None)
def elevation_matrix(degree: int, to_degree: int) -> Array:
    """Matrix E with `elevated = coefficients @ E.T`, shape (to_degree + 1, degree + 1), read-only.

    Each row is a convex combination, so that elevation never amplifies rounding.
    """
    if to_degree < degree:
        raise ValueError(f"cannot elevate degree {degree} to the lower degree {to_degree}")
    r = to_degree - degree
    E = np.array([[comb(degree, j) * comb(r, i - j) / comb(to_degree, i) if 0 <= i - j <= r else 0.0
                   for j in range(degree + 1)] for i in range(to_degree + 1)])
    E.setflags(write=False)
    return E


def elevate(coefficients: Array, to_degree: int) -> Array:
    """Express polynomials in the basis of a higher degree, shape (..., to_degree + 1)."""
    coefficients = np.asarray(coefficients, float)
    return coefficients @ elevation_matrix(coefficients.shape[-1] - 1, to_degree).T


def product(a: Array, b: Array) -> Array:
    """Coefficients of the products a(s) b(s).

    Args:
        a: shape (..., n + 1).
        b: shape (..., m + 1), with leading axes that broadcast against those of `a`.

    Returns:
        Array of shape (..., n + m + 1).
    """
    a, b = np.asarray(a, float), np.asarray(b, float)
    n, m = a.shape[-1] - 1, b.shape[-1] - 1
    scaled_a, scaled_b = a * binomials(n), b * binomials(m)
    out = np.zeros(np.broadcast_shapes(a.shape[:-1], b.shape[:-1]) + (n + m + 1,))
    for i in range(n + 1):
        out[..., i:i + m + 1] += scaled_a[..., i:i + 1] * scaled_b
    return out / binomials(n + m)


@lru_cache(maxsize=None)
def power_matrix(degree: int) -> Array:
    """Matrix M with `powers = coefficients @ M.T` for powers of s in ascending order, integers, read-only."""
    n = degree
    M = np.array([[(-1) ** (k - i) * comb(n, k) * comb(k, i) if i <= k else 0
                   for i in range(n + 1)] for k in range(n + 1)], float)
    M.setflags(write=False)
    return M


def to_powers(coefficients: Array) -> Array:
    """Coefficients of ascending powers of s, same shape. About 0.5 * degree digits are lost: do not use it for bounds."""
    coefficients = np.asarray(coefficients, float)
    return coefficients @ power_matrix(coefficients.shape[-1] - 1).T
