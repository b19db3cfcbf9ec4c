"""Virtual pinhole camera aimed at the pad: an upright, enlarged view through the fisheye lens.

The marker detector requires straight edges and tags of some 60 px; the fisheye delivers tags of 15 px at 3 m. A small
image resampled around the pad gives both, at a quarter of the cost of searching the whole enlarged frame.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from perch_core import so3
from perch_core.camera import Camera, Region

GRID = 8          # the lens is evaluated on every 8th pixel; linear in between it is good to 0.01 px
MAX_SIDE = 640    # of a view, unless it is given [px]
MAX_HALF_ANGLE = math.radians(60.0)  # a pinhole stretches without bound towards 90 deg
_BORDER = np.linspace(-1.0, 1.0, 9)  # places along a side of the view; between them the lens bends it by less than a pixel
_BORDER = np.concatenate([np.stack(pair, axis=-1) for ends in (-np.ones(9), np.ones(9)) for pair in ((_BORDER, ends), (ends, _BORDER))])


@dataclass(frozen=True)
class VirtualView:
    """A square pinhole image inside the field of view of a camera.

    Attributes:
        R_CV: attitude of the view V in the camera C (V: x right, y down, z forward), shape (3, 3).
        focal: focal length [px].
        side: width and height [px].
    """

    R_CV: np.ndarray
    focal: float
    side: int

    @property
    def centre(self) -> float:
        """Principal point, both coordinates [px]."""
        return 0.5 * (self.side - 1)

    @classmethod
    def aim(cls, direction_C: np.ndarray, half_angle: float, focal: float, max_side: int = MAX_SIDE) -> VirtualView:
        """Return the view along a direction that shows everything within an angle of it.

        Args:
            direction_C: viewing direction, shape (3,), any length.
            half_angle: angle that must be visible around it [rad]; limited to 60 deg.
            focal: desired focal length [px]; reduced where the image would exceed `max_side`.
            max_side: greatest width and height, a multiple of `GRID` [px].
        """
        z = direction_C / np.linalg.norm(direction_C)
        x = so3.cross(np.array([0.0, 1.0, 0.0]), z)
        if np.linalg.norm(x) < 1e-3:  # along the camera's y axis: any other reference will do
            x = so3.cross(np.array([1.0, 0.0, 0.0]), z)
        x /= np.linalg.norm(x)
        extent = 2.0 * math.tan(min(half_angle, MAX_HALF_ANGLE))
        focal = min(focal, max_side / extent)
        side = min(max_side, GRID * math.ceil(focal * extent / GRID + 1))
        return cls(np.stack([x, so3.cross(z, x), z], axis=1), focal, side)

    def rays(self, pixels: np.ndarray) -> np.ndarray:
        """Unit rays in C of pixels of the view, shapes (..., 2) -> (..., 3)."""
        plane = (np.asarray(pixels, float) - self.centre) / self.focal
        rays_V = np.concatenate([plane, np.ones_like(plane[..., :1])], axis=-1)
        return (rays_V / np.linalg.norm(rays_V, axis=-1, keepdims=True)) @ self.R_CV.T

    def region(self, camera: Camera, margin: int) -> Region:
        """Return the region of an image that the view shows, plus `margin` [px]; all of it where the view exceeds the lens."""
        pixels, valid = camera.project(self.rays(self.centre + 0.5 * self.side * _BORDER))
        if not valid.all():
            return slice(0, camera.height), slice(0, camera.width)
        size = np.array([camera.width, camera.height])
        low = np.clip(np.floor(pixels.min(axis=0)).astype(int) - margin, 0, size - 1)
        high = np.clip(np.ceil(pixels.max(axis=0)).astype(int) + margin + 1, low + 1, size)
        return slice(int(low[1]), int(high[1])), slice(int(low[0]), int(high[0]))

    def resample(self, image: np.ndarray, camera: Camera, origin: tuple[int, int] = (0, 0)) -> np.ndarray:
        """Resample the view from a camera's image, shape (side, side) uint8; black outside of the lens's image.

        Args:
            image: mono8, the camera's or a part of it that contains the view.
            camera: its lens.
            origin: column and row of the part's first pixel.
        """
        nodes = (np.arange(self.side // GRID) + 0.5) * GRID - 0.5  # where cv2.resize puts its samples
        grid = np.stack(np.meshgrid(nodes, nodes), axis=-1)
        pixels, valid = camera.project(self.rays(grid))
        coarse = np.where(valid[..., None], pixels, -1e4).astype(np.float32)
        source = np.asarray(cv2.resize(coarse, (self.side, self.side), interpolation=cv2.INTER_LINEAR)) - np.array(origin, np.float32)
        return cv2.remap(image, source, None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_CONSTANT, borderValue=0)  # type: ignore[call-overload]
