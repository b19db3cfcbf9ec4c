"""Bearings of many pixels at once and how they follow the focal length, compiled."""

from __future__ import annotations

import math

import numpy as np
from perch_core.camera import EquidistantCamera
from perch_core.jit import compiled
from perch_core.lens import angle, radius_slope


@compiled
def _observe(lens, pixels, b, by_focal):
    """Unit rays of pixels and their derivatives by the logarithm of the focal length; NaN where the lens sees nothing."""
    for n in range(pixels.shape[0]):
        x, y = (pixels[n, 0] - lens[2]) / lens[0], (pixels[n, 1] - lens[3]) / lens[1]
        r = math.sqrt(x * x + y * y)
        theta = angle(lens, r)
        s, c = math.sin(theta), math.cos(theta)
        ex, ey = (x / r, y / r) if r > 1e-12 else (0.0, 0.0)
        b[n, 0], b[n, 1], b[n, 2] = s * ex, s * ey, c
        turn = -r / radius_slope(lens, theta)  # d theta / d log f: the normalised radius shrinks as f grows
        by_focal[n, 0], by_focal[n, 1], by_focal[n, 2] = c * ex * turn, c * ey * turn, -s * turn


def observe(camera: EquidistantCamera, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit rays in C of pixels (n, 2) and their derivatives by the logarithm of the focal length, both (n, 3)."""
    b, by_focal = np.empty((len(pixels), 3)), np.empty((len(pixels), 3))
    _observe(camera.lens, np.ascontiguousarray(pixels, float), b, by_focal)
    return b, by_focal
