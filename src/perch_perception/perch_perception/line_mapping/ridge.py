"""Wires without a colour of their own: long, thin and darker than what is behind them.

A bank of elongated second-derivative filters answers to a dark line in its own direction and averages the texture
along it: on a textured wall a grey wire stands out by five times, where single edges are lost among the texture's.
"""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np

ORIENTATIONS = 16
ACROSS, ALONG = 2.0, 10.0  # 1-sigma of the filter at half resolution: wires of 3 to 12 px in the full image [px]
HALF_SIZE = 20             # of the kernels [px]


def dark_ridges(grey: np.ndarray) -> np.ndarray:
    """How much darker than its two sides a line through each pixel is.

    Args:
        grey: uint8, shape (height, width).

    Returns:
        Greatest answer over all directions [grey values], not below 0, float32, shape (height, width).
    """
    half = cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA).astype(np.float32)
    best = np.zeros_like(half)
    for kernel in _kernels():
        np.maximum(best, cv2.filter2D(half, -1, kernel), out=best)
    return cv2.resize(best, (grey.shape[1], grey.shape[0]), interpolation=cv2.INTER_LINEAR)


@lru_cache(maxsize=1)
def _kernels() -> tuple[np.ndarray, ...]:
    """Second derivatives of a Gaussian across, Gaussians along; without mean, of absolute sum 1."""
    y, x = np.mgrid[-HALF_SIZE:HALF_SIZE + 1, -HALF_SIZE:HALF_SIZE + 1]
    kernels = []
    for angle in np.pi * np.arange(ORIENTATIONS) / ORIENTATIONS:
        along, across = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
        kernel = ((across / ACROSS) ** 2 - 1.0) * np.exp(-0.5 * (across / ACROSS) ** 2 - 0.5 * (along / ALONG) ** 2)
        kernel -= kernel.mean()
        kernels.append((kernel / np.abs(kernel).sum()).astype(np.float32))
    return tuple(kernels)
