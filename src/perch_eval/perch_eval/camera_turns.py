"""Rotation of a camera between frames, from its images alone. Translation hardly affects the rotation about the optical axis."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from perch_core import so3
from perch_core.camera import Camera

CORNERS = 150
LEAST = 30      # rays in common
ROUNDS = 3      # of fits, each without the rays that are twice as far off as the median


def rotation_between(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Rotation of the camera between two sets of unit rays to the same points, (n, 3) each: R with `before = R after`."""
    keep = np.ones(len(before), bool)
    R = np.eye(3)
    for _ in range(ROUNDS):
        R = so3.nearest(before[keep].T @ after[keep])
        off = np.linalg.norm(before - after @ R.T, axis=1)
        keep = off <= 2.0 * np.median(off) + 1e-9
    return R


class CameraTurns:
    """Estimates the mean angular rate of a camera in C between consecutive images.

    Attributes:
        spans: (from, to) stamps [ns] and rates in C [rad/s], (3,).
    """

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self._last: tuple[int, np.ndarray, Any] | None = None
        self.spans: list[tuple[int, int, np.ndarray]] = []

    def add(self, stamp: int, image: np.ndarray) -> None:
        """Take an image, (height, width), or (height, width, 3)."""
        grey = np.ascontiguousarray(image if image.ndim == 2 else image[:, :, 1])
        if self._last is not None and self._last[2] is not None and stamp > self._last[0]:
            then, old, corners = self._last
            moved, found, _ = cv2.calcOpticalFlowPyrLK(old, grey, corners, None, winSize=(21, 21), maxLevel=4)  # type: ignore[call-overload]
            before, after = (self._camera.unproject(points.reshape(-1, 2).astype(float)) for points in (corners, moved))
            good = (found.ravel() == 1) & np.isfinite(before).all(axis=1) & np.isfinite(after).all(axis=1)
            if good.sum() >= LEAST:
                self.spans.append((then, stamp, so3.log(rotation_between(before[good], after[good])) / (1e-9 * (stamp - then))))
        self._last = stamp, grey, cv2.goodFeaturesToTrack(grey, CORNERS, 0.01, 12)

    def paired(self, stamps: np.ndarray, gyro: np.ndarray, offset: float) -> tuple[np.ndarray, np.ndarray]:
        """Rates of the gyroscope in B and of the camera in C over the same spans [rad/s], (n, 3) each.

        Args:
            stamps: of the gyroscope's samples [ns], (m,).
            gyro: [rad/s], (m, 3).
            offset: of the camera's stamps from the middle of its exposures [s].
        """
        pairs = []
        for begin, end, rate in self.spans:
            inside = (stamps > begin - 1e9 * offset) & (stamps <= end - 1e9 * offset)
            if inside.sum() > 3:
                pairs.append((gyro[inside].mean(axis=0), rate))
        both = np.array(pairs).reshape(-1, 2, 3)
        return both[:, 0], both[:, 1]
