"""The lens of Brown and Conrady with radial and tangential distortion, compiled: ROS's `plumb_bob` and `rational_polynomial`.

A point at (x, y) of the undistorted image plane (z = 1), r^2 = x^2 + y^2, is imaged at

    x' = x g(r^2) + 2 p1 x y + p2 (r^2 + 2 x^2),   y' = y g(r^2) + p1 (r^2 + 2 y^2) + 2 p2 x y,
    g(t) = (1 + k1 t + k2 t^2 + k3 t^3) / (1 + k4 t + k5 t^2 + k6 t^3).

The kernels take a `lens` (fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6, r_max, near) and fill arrays whose first axis is that
of the points. Beyond `r_max` the radius r g(r^2) decreases, and points would fold back into the image: they are not projected.
"""

from __future__ import annotations

import math
from typing import TypeVar

import numpy as np

from perch_core.arrays import Array
from perch_core.jit import compiled

F = TypeVar("F", float, Array)  # the plain functions take arrays, too

HALVINGS = 60       # of [0, r_max], for the radial part alone
NEWTON_STEPS = 30   # with the tangential part, from there
RESIDUAL = 1e-13    # in the normalised image plane


@compiled
def gain(lens: tuple[float, ...], t: F) -> F:
    """g(t)."""
    return (1.0 + t * (lens[4] + t * (lens[5] + t * lens[8]))) / (1.0 + t * (lens[9] + t * (lens[10] + t * lens[11])))


@compiled
def gain_slope(lens: tuple[float, ...], t: F) -> F:
    """d g / d t."""
    over, under = 1.0 + t * (lens[4] + t * (lens[5] + t * lens[8])), 1.0 + t * (lens[9] + t * (lens[10] + t * lens[11]))
    d_over, d_under = lens[4] + t * (2.0 * lens[5] + t * 3.0 * lens[8]), lens[9] + t * (2.0 * lens[10] + t * 3.0 * lens[11])
    return (d_over * under - over * d_under) / (under * under)


@compiled
def _distorted(lens: tuple[float, ...], x: float, y: float) -> tuple[float, float]:
    """x' and y'."""
    t, p1, p2 = x * x + y * y, lens[6], lens[7]
    g = gain(lens, t)
    return x * g + 2.0 * p1 * x * y + p2 * (t + 2.0 * x * x), y * g + p1 * (t + 2.0 * y * y) + 2.0 * p2 * x * y


@compiled
def _slopes(lens: tuple[float, ...], x: float, y: float) -> tuple[float, float, float]:
    """d x'/d x, d x'/d y = d y'/d x, d y'/d y."""
    t, p1, p2 = x * x + y * y, lens[6], lens[7]
    g, s = gain(lens, t), 2.0 * gain_slope(lens, t)
    return (g + s * x * x + 2.0 * p1 * y + 6.0 * p2 * x, s * x * y + 2.0 * p1 * x + 2.0 * p2 * y,
            g + s * y * y + 6.0 * p1 * y + 2.0 * p2 * x)


@compiled
def _regular(lens: tuple[float, ...], x: float, y: float) -> bool:
    """Return whether a point is within `r_max` and the image around it is neither folded nor mirrored."""
    if not x * x + y * y <= lens[12] * lens[12]:
        return False
    xx, xy, yy = _slopes(lens, x, y)
    return xx * yy - xy * xy > 0.0 and xx + yy > 0.0


@compiled
def project(lens: tuple[float, ...], points: Array, pixels: Array, valid: np.ndarray) -> None:
    """Pixels (n, 2) of points (n, 3), and which are valid, (n,); NaN behind the camera and beyond `r_max`."""
    for n in range(points.shape[0]):
        z = points[n, 2]
        valid[n] = z > lens[13] and _regular(lens, points[n, 0] / z, points[n, 1] / z)
        if not valid[n]:
            pixels[n, 0] = pixels[n, 1] = math.nan
            continue
        x, y = _distorted(lens, points[n, 0] / z, points[n, 1] / z)
        pixels[n, 0], pixels[n, 1] = lens[0] * x + lens[2], lens[1] * y + lens[3]


@compiled
def _undistorted(lens: tuple[float, ...], x_distorted: float, y_distorted: float) -> tuple[float, float]:
    """Return the point (x, y) that is imaged at (x', y'); NaN if there is none."""
    r_distorted = math.sqrt(x_distorted * x_distorted + y_distorted * y_distorted)
    if not r_distorted < math.inf:
        return math.nan, math.nan
    low, high = 0.0, lens[12]
    if high == math.inf:
        high = 1.0
        while high * gain(lens, high * high) < r_distorted and high < 1e6:
            high *= 2.0
    for _ in range(HALVINGS):
        r = 0.5 * (low + high)
        if r * gain(lens, r * r) < r_distorted:
            low = r
        else:
            high = r
    scale = high / r_distorted if r_distorted > 1e-12 else 1.0
    x, y = x_distorted * scale, y_distorted * scale
    for _ in range(NEWTON_STEPS):
        x_now, y_now = _distorted(lens, x, y)
        ex, ey = x_distorted - x_now, y_distorted - y_now
        if abs(ex) + abs(ey) <= RESIDUAL * (1.0 + r_distorted):
            break
        xx, xy, yy = _slopes(lens, x, y)
        det = xx * yy - xy * xy
        if not abs(det) > 1e-12:
            return math.nan, math.nan
        x, y = x + (yy * ex - xy * ey) / det, y + (xx * ey - xy * ex) / det
    x_now, y_now = _distorted(lens, x, y)
    if not (abs(x_distorted - x_now) + abs(y_distorted - y_now) <= 1e-11 * (1.0 + r_distorted) and _regular(lens, x, y)):
        return math.nan, math.nan
    return x, y


@compiled
def unproject(lens: tuple[float, ...], pixels: Array, rays: Array) -> None:
    """Unit rays (n, 3) of pixels (n, 2); NaN where no ray projects to the pixel."""
    for n in range(pixels.shape[0]):
        x, y = _undistorted(lens, (pixels[n, 0] - lens[2]) / lens[0], (pixels[n, 1] - lens[3]) / lens[1])
        z = 1.0 / math.sqrt(1.0 + x * x + y * y)
        rays[n, 0], rays[n, 1], rays[n, 2] = x * z, y * z, z


@compiled
def project_jacobian(lens: tuple[float, ...], points: Array, jacobian: Array) -> None:
    """Derivative of the pixel by the point, (n, 2, 3); NaN where `project` is not valid."""
    for n in range(points.shape[0]):
        z = points[n, 2]
        if not (z > lens[13] and _regular(lens, points[n, 0] / z, points[n, 1] / z)):
            jacobian[n, :, :] = math.nan
            continue
        x, y = points[n, 0] / z, points[n, 1] / z
        xx, xy, yy = _slopes(lens, x, y)
        jacobian[n, 0, 0], jacobian[n, 0, 1], jacobian[n, 0, 2] = lens[0] * xx / z, lens[0] * xy / z, -lens[0] * (xx * x + xy * y) / z
        jacobian[n, 1, 0], jacobian[n, 1, 1], jacobian[n, 1, 2] = lens[1] * xy / z, lens[1] * yy / z, -lens[1] * (xy * x + yy * y) / z
