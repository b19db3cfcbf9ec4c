"""The equidistant lens of Kannala and Brandt, compiled: kernels of `perch_core.camera.EquidistantCamera`.

A ray at the angle theta from the optical axis is imaged at the radius r(theta) = theta (1 + k1 theta^2 + k2 theta^4 +
k3 theta^6 + k4 theta^8) of the normalised image plane. The kernels take a `lens` (fx, fy, cx, cy, k1, k2, k3, k4, max_angle) and
fill arrays whose first axis is that of the points. In numpy a call costs 0.2-0.3 ms whatever its size; a frame needs dozens.
"""

from __future__ import annotations

import math
from typing import TypeVar

import numpy as np

from perch_core.arrays import Array
from perch_core.jit import compiled

F = TypeVar("F", float, Array)  # the plain functions take arrays, too

STEPS = 60  # Newton's method takes five for an ordinary lens; near a fold it leaves the bracket, which is then halved


@compiled
def radius(lens: tuple[float, ...], theta: F) -> F:
    """r(theta)."""
    t = theta * theta
    return theta * (1.0 + t * (lens[4] + t * (lens[5] + t * (lens[6] + t * lens[7]))))


@compiled
def radius_slope(lens: tuple[float, ...], theta: F) -> F:
    """d r / d theta."""
    t = theta * theta
    return 1.0 + t * (3.0 * lens[4] + t * (5.0 * lens[5] + t * (7.0 * lens[6] + t * 9.0 * lens[7])))


@compiled
def angle(lens: tuple[float, ...], r: float) -> float:
    """The inverse of `radius` by Newton's method within a bracket; NaN beyond `max_angle`."""
    max_angle = lens[8]
    if not r <= radius(lens, max_angle) + 1e-12:
        return math.nan
    low, high, theta = 0.0, max_angle, min(r, max_angle)
    for _ in range(STEPS):
        error, slope = radius(lens, theta) - r, radius_slope(lens, theta)
        if error > 0.0:
            high = theta
        else:
            low = theta
        if abs(error) < 1e-14 * slope:
            break
        inside = slope > 0.0 and low < theta - error / slope < high
        theta = theta - error / slope if inside else 0.5 * (low + high)
    return theta


@compiled
def project(lens: tuple[float, ...], points: Array, pixels: Array, valid: np.ndarray) -> None:
    """Pixels (n, 2) of points (n, 3), and which are valid, (n,); NaN beyond `max_angle` and in the optical centre."""
    for n in range(points.shape[0]):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        rho = math.sqrt(x * x + y * y)
        theta = math.atan2(rho, z)
        valid[n] = theta <= lens[8] and rho + abs(z) > 1e-9
        if not valid[n]:
            pixels[n, 0] = pixels[n, 1] = math.nan
            continue
        scale = radius(lens, theta) / rho if rho > 1e-12 else 1.0 / z
        pixels[n, 0], pixels[n, 1] = x * scale * lens[0] + lens[2], y * scale * lens[1] + lens[3]


@compiled
def unproject(lens: tuple[float, ...], pixels: Array, rays: Array) -> None:
    """Unit rays (n, 3) of pixels (n, 2); NaN where no ray projects to the pixel."""
    for n in range(pixels.shape[0]):
        x, y = (pixels[n, 0] - lens[2]) / lens[0], (pixels[n, 1] - lens[3]) / lens[1]
        r = math.sqrt(x * x + y * y)
        theta = angle(lens, r)
        scale = math.sin(theta) / r if r > 1e-12 else 1.0
        rays[n, 0], rays[n, 1], rays[n, 2] = x * scale, y * scale, math.cos(theta)


@compiled
def project_jacobian(lens: tuple[float, ...], points: Array, jacobian: Array) -> None:
    """Derivative of the pixel by the point, (n, 2, 3); NaN where `project` is not valid.

    With e = (x, y)/rho: d(r e) = (r/rho)(I - e e^T) d(x, y) + e r' d theta, and d theta = (z d rho - rho dz) / (rho^2 + z^2).
    """
    for n in range(points.shape[0]):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        rho = math.sqrt(x * x + y * y)
        theta = math.atan2(rho, z)
        if not (theta <= lens[8] and rho + abs(z) > 1e-9):
            jacobian[n, :, :] = math.nan
            continue
        ex, ey = (x / rho, y / rho) if rho >= 1e-9 else (1.0, 0.0)
        across = radius(lens, theta) / rho if rho >= 1e-9 else 1.0 / z
        slope, range2 = radius_slope(lens, theta), rho * rho + z * z
        along = slope * z / range2
        jacobian[n, 0, 0] = lens[0] * (across * (1.0 - ex * ex) + along * ex * ex)
        jacobian[n, 0, 1] = lens[0] * (along - across) * ex * ey
        jacobian[n, 1, 0] = lens[1] * (along - across) * ex * ey
        jacobian[n, 1, 1] = lens[1] * (across * (1.0 - ey * ey) + along * ey * ey)
        jacobian[n, 0, 2] = -lens[0] * slope * rho / range2 * ex
        jacobian[n, 1, 2] = -lens[1] * slope * rho / range2 * ey
