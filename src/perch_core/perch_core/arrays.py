"""Types of arrays and vectors in annotations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

Array = np.ndarray[tuple[Any, ...], np.dtype[np.float64]]
"""Array of floats of any shape; a plain `np.ndarray` may have any dtype."""
Indices = np.ndarray[tuple[Any, ...], np.dtype[np.int64]]
Flags = np.ndarray[tuple[Any, ...], np.dtype[np.bool_]]
Numbers = Sequence[float] | np.ndarray
"""Sequence of floats: a tuple, a list or an array with one axis."""
Vector3 = tuple[float, float, float]
Vector4 = tuple[float, float, float, float]
Quaternion = Vector4
"""Quaternion in the order x, y, z, w."""


def vector3(numbers: Numbers) -> Vector3:
    """Return three numbers as a tuple of floats."""
    x, y, z = numbers
    return float(x), float(y), float(z)


def quaternion(numbers: Numbers) -> Quaternion:
    """Return four numbers, xyzw, as a tuple of floats."""
    x, y, z, w = numbers
    return float(x), float(y), float(z), float(w)
