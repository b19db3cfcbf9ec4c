"""Compiled bearings and local lens model of many pixels."""

from __future__ import annotations

import math

import numpy as np
from perch_core.camera import EquidistantCamera
from perch_core.jit import compiled
from perch_core.lens import angle, radius_slope


@compiled
def _observe(lens, pixels, b, shape):
    """Fill unit rays `b` and lens model `shape` (`bearing.Bearings`) at pixels; NaN outside of the lens's image."""
    for n in range(pixels.shape[0]):
        x, y = (pixels[n, 0] - lens[2]) / lens[0], (pixels[n, 1] - lens[3]) / lens[1]
        r = math.sqrt(x * x + y * y)
        theta = angle(lens, r)
        s, c = math.sin(theta), math.cos(theta)
        ex, ey = (x / r, y / r) if r > 1e-12 else (0.0, 0.0)
        b[n, 0], b[n, 1], b[n, 2] = s * ex, s * ey, c
        shape[n, 0], shape[n, 1] = 1.0 / radius_slope(lens, theta), r / theta if r > 1e-12 else 1.0


def observe(camera: EquidistantCamera, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return unit rays in C of pixels (n, 2), shape (n, 3), and their `Bearings.shape`, shape (n, 2)."""
    b, shape = np.empty((len(pixels), 3)), np.empty((len(pixels), 2))
    _observe(camera.lens, np.ascontiguousarray(pixels, float), b, shape)
    return b, shape
