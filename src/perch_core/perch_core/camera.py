"""Cameras: pinhole, radial-tangential and equidistant projection with inverse and Jacobian.

Frame C: x to the right in the image, y down, z forward along the optical axis. Pixel (0, 0) is the centre of the
first pixel, as in OpenCV. Arrays may have any leading axes: points (..., 3), pixels (..., 2).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from types import ModuleType
from typing import ClassVar

import numpy as np

from perch_core import lens as kernels
from perch_core import radtan
from perch_core.arrays import Array
from perch_core.errors import ConfigError
from perch_core.jit import interpreted

IMAGE_SIZE_MIN = 16  # width and height of the smallest image [px]
FOCAL_MIN = 0.05  # least focal length, as a share of width or height: a pinhole would see 169 deg
Region = tuple[slice, slice]  # rows and columns of an image


@dataclass(frozen=True)
class _Camera:
    """Base of all projections: image size, focal lengths and principal point."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def __post_init__(self) -> None:
        for name in ("width", "height", "fx", "fy"):
            if not getattr(self, name) > 0:
                raise ConfigError(type(self).__name__, name, f"{getattr(self, name)!r} is not > 0 px")

    @cached_property
    def K(self) -> Array:
        """Intrinsic matrix, shape (3, 3) [px]."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def contains(self, pixels: Array, margin: float = 0.0) -> np.ndarray:
        """Whether pixels (..., 2) lie in the image, `margin` [px] inside its border; NaN does not. Shape (...)."""
        u, v = np.asarray(pixels)[..., 0], np.asarray(pixels)[..., 1]
        return ((u >= margin - 0.5) & (u <= self.width - 0.5 - margin)
                & (v >= margin - 0.5) & (v <= self.height - 0.5 - margin))


@dataclass(frozen=True)
class PinholeCamera(_Camera):
    """Perspective camera without distortion.

    Attributes:
        width, height: image size [px].
        fx, fy, cx, cy: focal lengths and principal point [px].
        near: points closer than this along the optical axis are not projected [m].
    """

    near: float = 1e-3
    model = "plumb_bob"  # the name in sensor_msgs/CameraInfo
    distortion = np.zeros(5)

    @property
    def max_angle(self) -> float:
        """Largest angle from the optical axis at which a point is projected [rad]."""
        return math.pi / 2

    def project(self, points_C: Array) -> tuple[Array, np.ndarray]:
        """Pixels of points in C.

        Args:
            points_C: shape (..., 3) [m].

        Returns:
            Pixels (..., 2), NaN where the point is not in front of the camera, and the mask (...) of the valid ones.
            A valid pixel may lie outside the image: see `contains`.
        """
        points_C = np.asarray(points_C, dtype=float)
        valid = points_C[..., 2] > self.near
        z = np.where(valid, points_C[..., 2], 1.0)
        pixels = points_C[..., :2] / z[..., None] * (self.fx, self.fy) + (self.cx, self.cy)
        return np.where(valid[..., None], pixels, np.nan), valid

    def unproject(self, pixels: Array) -> Array:
        """Unit rays in C, shape (..., 3), of pixels (..., 2)."""
        plane = (np.asarray(pixels, dtype=float) - (self.cx, self.cy)) / (self.fx, self.fy)
        rays_C = np.concatenate([plane, np.ones_like(plane[..., :1])], axis=-1)
        lengths: Array = np.linalg.norm(rays_C, axis=-1, keepdims=True)
        return rays_C / lengths

    def project_jacobian(self, points_C: Array) -> Array:
        """Derivative of the pixel by the point, shape (..., 2, 3) [px/m]; NaN where `project` is not valid."""
        points_C = np.asarray(points_C, dtype=float)
        x, y, z = np.moveaxis(np.where(points_C[..., 2:] > self.near, points_C, np.nan), -1, 0)
        zero = 0.0 * z
        return np.stack([np.stack([self.fx / z, zero, -self.fx * x / z**2], -1),
                         np.stack([zero, self.fy / z, -self.fy * y / z**2], -1)], -2)

    def shape_at(self, theta: Array) -> Array:
        """d theta / d r and r / theta, shape (n, 2), at angles theta (n,) from the axis; r is the normalised image radius."""
        theta = np.asarray(theta, float) + 1e-9
        return np.column_stack([np.cos(theta) ** 2, np.tan(theta) / theta])


class _DistortedCamera(_Camera):
    """Base of the cameras with distortion: compiled kernels evaluate the equations from the tuple `lens`."""

    _kernels: ClassVar[ModuleType]

    @property
    def lens(self) -> tuple[float, ...]:
        raise NotImplementedError

    def project(self, points_C: Array) -> tuple[Array, np.ndarray]:
        """Pixels of points in C.

        Args:
            points_C: shape (..., 3) [m].

        Returns:
            Pixels (..., 2), NaN where no projection exists: behind the camera, in its optical centre, or beyond `max_angle`;
            and the mask (...) of the valid ones. A valid pixel may lie outside the image: see `contains`.
        """
        points, shape = _rows(points_C, 3)
        pixels, valid = np.empty((len(points), 2)), np.empty(len(points), bool)
        self._kernels.project(self.lens, points, pixels, valid)
        return pixels.reshape(*shape, 2), valid.reshape(shape)

    def unproject(self, pixels: Array) -> Array:
        """Unit rays in C, shape (..., 3), of pixels (..., 2); NaN where no ray projects to the pixel."""
        rows, shape = _rows(pixels, 2)
        rays_C = np.empty((len(rows), 3))
        self._kernels.unproject(self.lens, rows, rays_C)
        return rays_C.reshape(*shape, 3)

    def project_jacobian(self, points_C: Array) -> Array:
        """Derivative of the pixel by the point, shape (..., 2, 3) [px/m]; NaN where `project` is not valid."""
        points, shape = _rows(points_C, 3)
        jacobian = np.empty((len(points), 2, 3))
        self._kernels.project_jacobian(self.lens, points, jacobian)
        return jacobian.reshape(*shape, 2, 3)


@dataclass(frozen=True)
class RadialTangentialCamera(_DistortedCamera):
    """Perspective camera with the distortion of Brown and Conrady: ROS's `plumb_bob` and `rational_polynomial`, OpenCV's default.

    The equations are in `perch_core.radtan`. Points where the polynomial would fold back into the image are not projected.

    Attributes:
        width, height: image size [px].
        fx, fy, cx, cy: focal lengths and principal point [px].
        coefficients: k1, k2, p1, p2, k3 (`plumb_bob`), and k4, k5, k6 (`rational_polynomial`): five or eight.
        near: points closer than this along the optical axis are not projected [m].
    """

    coefficients: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)
    near: float = 1e-3
    _kernels: ClassVar[ModuleType] = radtan

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "coefficients", tuple(float(k) for k in self.coefficients))
        if len(self.coefficients) not in (5, 8) or not np.all(np.isfinite(self.coefficients)):
            raise ConfigError("RadialTangentialCamera", "coefficients", f"{self.coefficients!r} are not five or eight numbers")

    @property
    def model(self) -> str:
        """Name of the distortion model in sensor_msgs/CameraInfo."""
        return "plumb_bob" if len(self.coefficients) == 5 else "rational_polynomial"

    @cached_property
    def distortion(self) -> Array:
        """Distortion coefficients, shape (5,) or (8,)."""
        return np.array(self.coefficients, dtype=float)

    @cached_property
    def max_radius(self) -> float:
        """Largest distance from the axis in the plane z = 1 at which a point is projected; inf where there is no limit."""
        k1, k2, _, _, k3, k4, k5, k6 = (*self.coefficients, 0.0, 0.0, 0.0)[:8]
        over, under = np.polynomial.Polynomial([1.0, k1, k2, k3]), np.polynomial.Polynomial([1.0, k4, k5, k6])
        t = np.polynomial.Polynomial([0.0, 1.0])
        slope = (over + 2 * t * over.deriv()) * under - 2 * t * over * under.deriv()  # of r g(r^2), times under^2
        # a hair before the turning point itself, where the inverse has no slope
        return min((0.995 * root for root in (*_positive_roots(slope), *_positive_roots(under))), default=math.inf)

    @property
    def max_angle(self) -> float:
        """Largest angle from the optical axis at which a point is projected [rad]."""
        return math.atan(self.max_radius)

    @cached_property
    def lens(self) -> tuple[float, ...]:
        """Parameters as the kernels of `perch_core.radtan` take them."""
        k = (*self.coefficients, 0.0, 0.0, 0.0)[:8]
        return tuple(float(x) for x in (self.fx, self.fy, self.cx, self.cy, *k, self.max_radius, self.near))

    def shape_at(self, theta: Array) -> Array:
        """d theta / d r and r / theta, shape (n, 2), at angles theta (n,) from the axis; r is the normalised image radius."""
        theta = np.asarray(theta, float) + 1e-9
        out = np.tan(theta)
        g, slope = interpreted(radtan.gain)(self.lens, out**2), interpreted(radtan.gain_slope)(self.lens, out**2)
        return np.column_stack([np.cos(theta) ** 2 / (g + 2.0 * out**2 * slope), out * g / theta])


@dataclass(frozen=True)
class EquidistantCamera(_DistortedCamera):
    """Fisheye camera of Kannala and Brandt with four coefficients: ROS's `equidistant`, OpenCV's `fisheye`.

    A ray at the angle theta from the optical axis is imaged at the radius
    theta_d = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8) of the normalised image plane.
    The polynomial of a real lens has a maximum somewhere beyond 90 deg, and points past it would fold back
    into the image: points beyond `max_angle` are not projected.

    Attributes:
        width, height: image size [px].
        fx, fy, cx, cy: focal lengths and principal point [px].
        coefficients: k1..k4.
        angle_limit: largest angle from the optical axis that the lens covers [rad]; the maximum of the
            polynomial limits it further.
    """

    coefficients: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    angle_limit: float = math.pi / 2
    model = "equidistant"
    _kernels: ClassVar[ModuleType] = kernels

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "coefficients", tuple(float(k) for k in self.coefficients))
        if len(self.coefficients) != 4 or not np.all(np.isfinite(self.coefficients)):
            raise ConfigError("EquidistantCamera", "coefficients", f"{self.coefficients!r} are not four numbers")
        if not 0 < self.angle_limit <= math.pi:
            raise ConfigError("EquidistantCamera", "angle_limit", f"{self.angle_limit!r} is outside (0, pi] rad")

    @cached_property
    def distortion(self) -> Array:
        """k1..k4, shape (4,)."""
        return np.array(self.coefficients, dtype=float)

    @cached_property
    def max_angle(self) -> float:
        """Largest angle from the optical axis at which a point is projected [rad]."""
        k1, k2, k3, k4 = self.coefficients
        slope = np.polynomial.Polynomial([1.0, 3 * k1, 5 * k2, 7 * k3, 9 * k4])  # d theta_d / d theta in theta^2
        # a hair before the turning point itself, where the inverse has no slope
        return min([self.angle_limit, *(0.995 * turning for turning in _positive_roots(slope))])

    @cached_property
    def lens(self) -> tuple[float, ...]:
        """Parameters as the kernels of `perch_core.lens` take them."""
        return tuple(float(x) for x in (self.fx, self.fy, self.cx, self.cy, *self.coefficients, self.max_angle))

    def radius(self, theta: float) -> float:
        """theta_d, the radius in the normalised image plane of a ray at the angle theta [rad]."""
        return kernels.radius(self.lens, float(theta))

    def shape_at(self, theta: Array) -> Array:
        """d theta / d r and r / theta, shape (n, 2), at angles theta (n,) from the axis; r is the normalised image radius."""
        theta = np.asarray(theta, float)
        r = interpreted(kernels.radius)(self.lens, theta)
        ratio = np.divide(r, theta, out=np.ones_like(theta), where=theta > 1e-12)
        return np.column_stack([1.0 / interpreted(kernels.radius_slope)(self.lens, theta), ratio])


def _rows(array: Array, width: int) -> tuple[Array, tuple[int, ...]]:
    """Return vectors with any leading shape as rows, shape (n, width), and that leading shape."""
    array = np.asarray(array, dtype=float)
    return np.ascontiguousarray(array).reshape(-1, width), array.shape[:-1]


def _positive_roots(polynomial: np.polynomial.Polynomial) -> list[float]:
    """Square roots of the real positive roots of a polynomial."""
    roots: np.ndarray = polynomial.trim(1e-300).roots()
    return [math.sqrt(root.real) for root in roots if abs(root.imag) < 1e-12 and root.real > 0]


Camera = PinholeCamera | RadialTangentialCamera | EquidistantCamera


def camera_of(model: str, width: int, height: int, K: Array, distortion: Array) -> Camera:
    """Return the camera of a calibration given as in sensor_msgs/CameraInfo.

    Args:
        model: `plumb_bob`, `rational_polynomial` or `equidistant`; empty: no distortion.
        width, height: image size [px].
        K: intrinsic matrix, shape (3, 3).
        distortion: coefficients of the model; empty: no distortion.

    Raises:
        ConfigError: unknown model, wrong number of coefficients, invalid size or intrinsic matrix (all zero, or focal lengths
            that no lens has: not calibrated).
    """
    K, d = np.asarray(K, float), np.asarray(distortion, float).ravel()
    if K.shape != (3, 3) or not np.isfinite(K).all() or K[0, 0] <= 0.0 or K[1, 1] <= 0.0:
        raise ConfigError("camera_info", "k", f"{K.ravel().tolist()} is no intrinsic matrix: the camera is not calibrated")
    if not np.isfinite(d).all():
        raise ConfigError("camera_info", "d", f"{d.tolist()} is not finite")
    if not IMAGE_SIZE_MIN <= width <= 1 << 15 or not IMAGE_SIZE_MIN <= height <= 1 << 15:
        raise ConfigError("camera_info", "width", f"{width} x {height} px: each must be within [{IMAGE_SIZE_MIN}, {1 << 15}] px")
    if K[0, 0] < FOCAL_MIN * width or K[1, 1] < FOCAL_MIN * height:
        raise ConfigError("camera_info", "k", f"focal lengths of {K[0, 0]:g} and {K[1, 1]:g} px for {width} x {height} px: the camera is not calibrated")
    common = int(width), int(height), float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])
    counts = {"": (0,), "plumb_bob": (0, 4, 5), "rational_polynomial": (0, 8), "equidistant": (0, 4)}
    if model not in counts:
        raise ConfigError("camera_info", "distortion_model", f"{model!r} is not one of {', '.join(filter(None, counts))}")
    if len(d) not in counts[model]:
        raise ConfigError("camera_info", "d", f"has {len(d)} coefficients, {model or 'no model'} has {counts[model][-1]}")
    if model == "equidistant":
        return EquidistantCamera(*common, coefficients=tuple(d) or (0.0,) * 4)
    if not d.any():
        return PinholeCamera(*common)
    return RadialTangentialCamera(*common, coefficients=tuple(d) if len(d) != 4 else (*d, 0.0))


def camera_parameters(camera: Camera) -> tuple[str, tuple[float, ...]]:
    """Distortion model and coefficients of a camera as in sensor_msgs/CameraInfo."""
    return camera.model, tuple(float(k) for k in camera.distortion)
