"""Ridges in a grey image, brighter or darker than both their sides, at several widths: points, directions, signs.

Across a ridge the grey value has its largest curvature and zero slope, which distinguishes a line from an edge (Steger, "An
unbiased detector of curvilinear structures", 1998). The zero lies within the pixel, and locates the line to a tenth of a pixel.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

BLUR = 1.1            # of each level of the pyramid before it is differentiated: answers to lines 1 to 4 px wide there [px]
LEVELS = 3            # lines 1 to 16 px wide in the full image
MIN_BEND = 1.0        # least curvature across a ridge, at its level [grey values / px^2]
ROUNDISH = 0.5        # curvature along a ridge, as a share of that across it: more is a spot
BESIDE = 3.0          # where the sides of a ridge are looked at, at its level [px]
MOST = 6000           # ridge points kept of each sign, those that bend most


@dataclass(frozen=True)
class Ridges:
    """Ridge points of one image.

    Attributes:
        pixels: shape (n, 2) [px].
        tangents: unit vectors along the ridges, shape (n, 2).
        bend: curvature across them, below 0 where brighter than their sides, shape (n,) [grey values / px^2 of the level].
        step: grey value on the right of the tangent (in the image, y down) minus that on the left, shape (n,) [grey values].
        height: grey value above (below: negative) the mean of both sides, shape (n,) [grey values].
        level: of the pyramid in which they were found: at 2^-level of the resolution, shape (n,).
    """

    pixels: np.ndarray
    tangents: np.ndarray
    bend: np.ndarray
    step: np.ndarray
    height: np.ndarray
    level: np.ndarray


def ridges(grey: np.ndarray) -> Ridges:
    """Return the ridge points of an image, uint8 (height, width)."""
    found, level_image = [], np.asarray(grey, np.float32)
    for level in range(LEVELS):
        found.append(_of_level(level_image, level))
        level_image = np.asarray(cv2.resize(level_image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))
    columns = [np.concatenate(column) for column in zip(*found)]
    bend = columns[2]
    signs = (np.flatnonzero(bend < 0.0), np.flatnonzero(bend >= 0.0))
    keep = np.concatenate([sign[np.argsort(-np.abs(bend[sign]), kind="stable")[:MOST]] for sign in signs])
    return Ridges(*(column[keep] for column in columns))


def _of_level(image: np.ndarray, level: int) -> tuple[np.ndarray, ...]:
    """Return the columns of `Ridges` from one level of the pyramid, in pixels of the full image."""
    smooth = np.asarray(cv2.GaussianBlur(image, (0, 0), BLUR))
    slope, bend, one = (np.array(kernel, np.float32) for kernel in ([-0.5, 0.0, 0.5], [1.0, -2.0, 1.0], [1.0]))
    xx, yy, xy = (np.asarray(cv2.sepFilter2D(smooth, -1, a, b)) for a, b in ((bend, one), (one, bend), (slope, slope)))
    mean, spread = 0.5 * (xx + yy), np.sqrt(0.25 * (xx - yy) ** 2 + xy**2)
    across = np.abs(mean) + spread
    rows, cols = np.nonzero((across > MIN_BEND) & (np.abs(np.abs(mean) - spread) < ROUNDISH * across))
    xx, yy, xy = (part[rows, cols] for part in (xx, yy, xy))
    mean, spread = mean[rows, cols], spread[rows, cols]
    by_x, by_y = (np.asarray(cv2.sepFilter2D(smooth, -1, a, b))[rows, cols] for a, b in ((slope, one), (one, slope)))
    curved = mean + np.copysign(spread, mean)
    angle = 0.5 * np.arctan2(2.0 * xy, xx - yy) + np.where(mean < 0.0, 0.5 * np.pi, 0.0)
    normal = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    shift = -(by_x * normal[:, 0] + by_y * normal[:, 1]) / curved
    on = (np.abs(shift[:, None] * normal) <= 0.6).all(axis=1)
    rows, cols, normal = rows[on], cols[on], normal[on]
    right, left = (smooth[np.clip(np.rint(rows + side * normal[:, 1]).astype(int), 0, smooth.shape[0] - 1),
                          np.clip(np.rint(cols + side * normal[:, 0]).astype(int), 0, smooth.shape[1] - 1)] for side in (BESIDE, -BESIDE))
    pixels = np.stack([cols, rows], axis=1) + shift[on, None] * normal
    tangents = np.stack([normal[:, 1], -normal[:, 0]], axis=1)
    return ((pixels + 0.5) * 2**level - 0.5, tangents, curved[on], right - left, smooth[rows, cols] - 0.5 * (right + left),
            np.full(len(pixels), level))
