"""Vector algebra on tuples of components, so that one formula serves numbers, arrays and CasADi symbols.

A vector is a tuple of components; each component is a float, a numpy array (many vectors at once: any shape, the same
for all) or a CasADi `SX`/`MX` scalar. This module does not import CasADi: symbols implement the arithmetic. As formulas are
written out by component, products with constant zeros vanish from the symbolic graph, which keeps compiled functions small.
"""

from __future__ import annotations

from typing import Any

import numpy as np

Scalar = Any  # float, numpy array or CasADi scalar
Vector = tuple[Scalar, ...]


def components(vector: Any) -> Vector:
    """Return the components of a vector: along the last axis of an array, the rows of a CasADi column, or a tuple unchanged."""
    if isinstance(vector, tuple):
        return vector
    if isinstance(vector, (np.ndarray, list)):
        return tuple(np.moveaxis(np.asarray(vector, float), -1, 0))
    return tuple(vector[i] for i in range(vector.shape[0]))


def stack(vector: Vector) -> np.ndarray:
    """Numeric components as an array with the components on the last axis."""
    return np.stack(np.broadcast_arrays(*vector), axis=-1)


def function(name: str, value: Scalar) -> Scalar:
    """Apply `sqrt`, `arctan`, `tanh` or `exp` to a number, an array or a symbol (by the symbol's own method)."""
    method = getattr(value, name, None)
    return method() if method is not None else getattr(np, name)(value)


def add(a: Vector, b: Vector) -> Vector:
    """Sum of two vectors."""
    return tuple(x + y for x, y in zip(a, b, strict=True))


def subtract(a: Vector, b: Vector) -> Vector:
    """Difference of two vectors."""
    return tuple(x - y for x, y in zip(a, b, strict=True))


def scale(factor: Scalar, a: Vector) -> Vector:
    """A vector times a scalar."""
    return tuple(factor * x for x in a)


def dot(a: Vector, b: Vector) -> Scalar:
    """Scalar product."""
    total = a[0] * b[0]
    for x, y in zip(a[1:], b[1:], strict=True):
        total = total + x * y
    return total


def cross(a: Vector, b: Vector) -> Vector:
    """Vector product of two 3-vectors."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def matrix_of(q_AB: Vector) -> tuple[Vector, Vector, Vector]:
    """Rows of the rotation matrix R_AB of a unit quaternion xyzw."""
    x, y, z, w = q_AB
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )


def rotate(q_AB: Vector, v_B: Vector) -> Vector:
    """Rotate a vector from B to A: `q_AB (.) v_B`."""
    return tuple(dot(row, v_B) for row in matrix_of(q_AB))


def rotate_back(q_AB: Vector, v_A: Vector) -> Vector:
    """Rotate a vector from A to B: `q_BA (.) v_A`."""
    return tuple(dot(column, v_A) for column in zip(*matrix_of(q_AB)))
