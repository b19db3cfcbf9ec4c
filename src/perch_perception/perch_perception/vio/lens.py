"""The equidistant lens for a hundred features at once, compiled: the formulas of `perch_core.camera.EquidistantCamera`.

Its methods take any shape and cost 0.2-0.3 ms a call whatever its size; a frame needs four of them.
"""

from __future__ import annotations

import math

import numpy as np
from perch_core.camera import NEWTON_STEPS, Camera, EquidistantCamera
from perch_core.jit import compiled


@compiled
def _observe(pixels, intrinsics, k, max_angle, b, by_focal):
    """Unit rays of pixels and their derivatives by the logarithm of the focal length; NaN where the lens sees nothing."""
    fx, fy, cx, cy = intrinsics
    k1, k2, k3, k4 = k
    t = max_angle * max_angle
    largest = max_angle * (1.0 + t * (k1 + t * (k2 + t * (k3 + t * k4)))) + 1e-12
    for n in range(pixels.shape[0]):
        x, y = (pixels[n, 0] - cx) / fx, (pixels[n, 1] - cy) / fy
        r = math.sqrt(x * x + y * y)
        if not r <= largest:
            for i in range(3):
                b[n, i] = by_focal[n, i] = math.nan
            continue
        theta = min(r, max_angle)
        slope = 1.0
        for _ in range(NEWTON_STEPS):
            t = theta * theta
            slope = 1.0 + t * (3.0 * k1 + t * (5.0 * k2 + t * (7.0 * k3 + t * 9.0 * k4)))
            step = (theta * (1.0 + t * (k1 + t * (k2 + t * (k3 + t * k4)))) - r) / slope
            theta = min(max(theta - step, 0.0), max_angle)
            if abs(step) < 1e-13:
                break
        s, c = math.sin(theta), math.cos(theta)
        ex, ey = (x / r, y / r) if r > 1e-12 else (0.0, 0.0)
        b[n, 0], b[n, 1], b[n, 2] = s * ex, s * ey, c
        angle = -r / slope  # d theta / d log f: the normalised radius shrinks as f grows
        by_focal[n, 0], by_focal[n, 1], by_focal[n, 2] = c * ex * angle, c * ey * angle, -s * angle


@compiled
def _project(rays, intrinsics, k, max_angle, pixels, valid):
    """Pixels of rays; NaN beyond `max_angle`."""
    fx, fy, cx, cy = intrinsics
    k1, k2, k3, k4 = k
    for n in range(rays.shape[0]):
        x, y, z = rays[n, 0], rays[n, 1], rays[n, 2]
        rho = math.sqrt(x * x + y * y)
        theta = math.atan2(rho, z)
        valid[n] = theta <= max_angle
        if not valid[n]:
            pixels[n, 0] = pixels[n, 1] = math.nan
            continue
        t = theta * theta
        scale = theta * (1.0 + t * (k1 + t * (k2 + t * (k3 + t * k4)))) / rho if rho > 1e-12 else 1.0 / z
        pixels[n, 0], pixels[n, 1] = x * scale * fx + cx, y * scale * fy + cy


def _constants(camera: EquidistantCamera) -> tuple:
    return (float(camera.fx), float(camera.fy), float(camera.cx), float(camera.cy)), camera.coefficients, float(camera.max_angle)


def observe(camera: EquidistantCamera, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit rays in C of pixels (n, 2) and their derivatives by the logarithm of the focal length, both (n, 3)."""
    b, by_focal = np.empty((len(pixels), 3)), np.empty((len(pixels), 3))
    _observe(np.ascontiguousarray(pixels, float), *_constants(camera), b, by_focal)
    return b, by_focal


def project(camera: Camera, rays_C: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels of rays (n, 3) in C, shape (n, 2), NaN where not valid, and which are valid, (n,): as `camera.project`."""
    if not isinstance(camera, EquidistantCamera):
        return camera.project(rays_C)
    pixels, valid = np.empty((len(rays_C), 2)), np.empty(len(rays_C), bool)
    _project(np.ascontiguousarray(rays_C, float), *_constants(camera), pixels, valid)
    return pixels, valid
