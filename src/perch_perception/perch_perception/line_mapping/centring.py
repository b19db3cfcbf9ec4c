"""Centre line of a plain wire: the middle between its two edges, in the mean of many profiles across it.

Ridge points of a thick wire arise on its whole width and on its rims alike, and scatter by half a pixel about its middle.
"""

from __future__ import annotations

import cv2
import numpy as np

from perch_core.camera import Camera

STEP = 0.5         # spacing of a profile [px]
PLACES = 31        # profiles that are averaged at each ray
ASIDE = 9.0        # half length of a profile, at the wire's level [px]
WIDEST = 12.0      # distance of the two edges, at most, at the wire's level [px]
FARTHEST = 3.0     # of the middle from the ridge points' mean, at its level [px]


def centred(grey: np.ndarray, camera: Camera, rays_C: np.ndarray, bright: bool, level: float) -> np.ndarray:
    """Return rays to the middle of a wire.

    Args:
        grey: uint8, shape (height, width).
        camera: its lens.
        rays_C: unit rays near the wire's axis, in order along it, shape (n, 3).
        bright: whether the wire is brighter than its background.
        level: level of the image pyramid in which the wire is one to four pixels wide.

    Returns:
        Unit rays, shape (n, 3); a ray is unchanged where no two edges are found.
    """
    scale = 2.0**level
    pixels = camera.project(rays_C)[0]
    along = np.gradient(pixels, axis=0)
    normal = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.linalg.norm(along, axis=1, keepdims=True)
    s = np.arange(-ASIDE * scale, ASIDE * scale + 0.1, STEP)
    places = pixels[:, None] + np.linspace(-0.5, 0.5, PLACES)[:, None] * along[:, None]            # (n, k, 2)
    where = (places[:, :, None] + s[:, None] * normal[:, None, None]).astype(np.float32)           # (n, k, S, 2)
    profiles = cv2.remap(grey, where[..., 0].reshape(-1, len(s)), where[..., 1].reshape(-1, len(s)), cv2.INTER_LINEAR,
                         borderMode=cv2.BORDER_REPLICATE).reshape(len(pixels), PLACES, len(s)).astype(float)
    mean = cv2.GaussianBlur(profiles.mean(axis=1), (0, 0), 0.8 / STEP, sigmaY=1e-3, borderType=cv2.BORDER_REPLICATE)
    slope = np.diff(mean if bright else -mean, axis=1)
    at = 0.5 * (s[1:] + s[:-1])
    begin, end = at[:, None], at[None, :]
    allowed = (end > begin) & (end - begin < WIDEST * scale) & (np.abs(0.5 * (begin + end)) < FARTHEST * scale)
    best = np.array([np.unravel_index(np.argmax(np.where(allowed, one[:, None] - one[None, :], -np.inf)), allowed.shape) for one in slope])
    best = np.clip(best, 1, len(at) - 2)
    row = np.arange(len(pixels))[:, None]
    before, peak, after = (slope[row, best + k] * (1.0, -1.0) for k in (-1, 0, 1))
    edges = at[best] + STEP * np.clip(0.5 * (before - after) / np.minimum(before - 2.0 * peak + after, -1e-9), -1.0, 1.0)
    middle = np.where((peak > 0.0).all(axis=1), edges.mean(axis=1), 0.0)
    rays = camera.unproject(pixels + middle[:, None] * normal)
    return np.where(np.isfinite(rays).all(axis=1, keepdims=True), rays, rays_C)
