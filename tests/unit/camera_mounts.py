"""Mounts of cameras for tests."""

from __future__ import annotations

import numpy as np


def looking_along(forward_B: np.ndarray, up_B: np.ndarray) -> np.ndarray:
    """R_BC of a camera that looks along `forward_B` with the image's upper side towards `up_B`, shape (3, 3)."""
    z = np.asarray(forward_B, dtype=float) / np.linalg.norm(forward_B)
    y = -np.asarray(up_B, dtype=float)
    y = y - (y @ z) * z
    y /= np.linalg.norm(y)
    return np.stack([np.cross(y, z), y, z], axis=1)
