"""Types of arrays and vectors in annotations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

Array = np.ndarray[tuple[Any, ...], np.dtype[np.float64]]
"""Floats, any shape; a plain `np.ndarray` may hold anything."""
Indices = np.ndarray[tuple[Any, ...], np.dtype[np.int64]]
Flags = np.ndarray[tuple[Any, ...], np.dtype[np.bool_]]
Numbers = Sequence[float] | np.ndarray
"""Floats in order: a tuple, a list, an array with one axis."""
Vector3 = tuple[float, float, float]
Vector4 = tuple[float, float, float, float]
Quaternion = Vector4
"""xyzw."""


def vector3(numbers: Numbers) -> Vector3:
    """Three numbers as floats."""
    x, y, z = numbers
    return float(x), float(y), float(z)


def quaternion(numbers: Numbers) -> Quaternion:
    """Four numbers, xyzw, as floats."""
    x, y, z, w = numbers
    return float(x), float(y), float(z), float(w)
