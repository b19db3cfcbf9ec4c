"""Check whether a line is a free wire: the background moves relative to a wire, but with a kerb, a road mark or a seam of a wall.

Between two images the surroundings of a sighting shift according to their distance. Let i be their inverse distance, as a share
of the wire's. Their pixels shift from those for an infinite distance (i = 0) towards those for the wire's distance (i = 1): the
optical flow beside the wire measures i.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from perch_core.camera import Camera
from perch_perception.line_mapping.curve import WireCurve
from perch_perception.line_mapping.observation import LineObservation

SIDE_OFFSETS = (-24.0, -17.0, 17.0, 24.0)  # places beside a wire that are tracked, clear of a wire of 20 px [px]
WINDOW = 11                        # of the optical flow [px]
MAX_RETURN_ERROR = 0.7             # flow there and back ends within this [px]
MIN_SHIFT = 3.0                    # between both hypotheses, across the wire; less does not distinguish them [px]
MIN_PLACES = 6                     # places that must be tracked
ATTACHED, APART = 0.8, 0.6         # i of what carries the wire, and of what is behind it
BASELINE, MAX_AGE = 0.1, 1.0       # distance [m] and time [s] after which the image to compare with is replaced


@dataclass(frozen=True)
class _View:
    """An image, mono8, and the pose of its camera."""

    grey: np.ndarray
    time: float
    p_WC: np.ndarray
    R_WC: np.ndarray

    def project(self, camera: Camera, points_W: np.ndarray) -> np.ndarray:
        """Return the pixels of points (n, 3); NaN outside of the lens's image."""
        return camera.project((points_W - self.p_WC) @ self.R_WC)[0]


class BackgroundCheck:
    """Compares each image with one taken some centimetres before."""

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self._before: _View | None = None
        self._now: _View | None = None

    def add_image(self, grey: np.ndarray, time: float, p_WC: np.ndarray, R_WC: np.ndarray) -> None:
        """Add the next image, mono8, its time [s] and its camera's pose."""
        if self._now is not None and (self._before is None or time - self._before.time > MAX_AGE
                                      or np.linalg.norm(p_WC - self._before.p_WC) > BASELINE):
            self._before = self._now
        self._now = _View(grey, time, np.array(p_WC), np.array(R_WC))

    def is_on_surface(self, seen: LineObservation, curve: WireCurve) -> bool | None:
        """Whether a sighting in the last image lies on the surface beside it; None where the motion does not decide this.

        Args:
            seen: the sighting, with the last image's pose.
            curve: the wire, which gives its distance.
        """
        now, before, camera = self._now, self._before, self._camera
        if now is None or before is None:
            return None
        points_W = curve.at(curve.nearest(np.tile(seen.p_WC, (len(seen.rays_W), 1)), seen.rays_W))
        on = camera.project(seen.rays_W @ now.R_WC)[0]
        along = np.gradient(on, axis=0)
        normal = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.linalg.norm(along, axis=1, keepdims=True)
        places = (on + np.array(SIDE_OFFSETS)[:, None, None] * normal).reshape(-1, 2)
        rays_W = camera.unproject(places) @ now.R_WC.T
        distance = np.tile(np.linalg.norm(points_W - seen.p_WC, axis=1), len(SIDE_OFFSETS))
        near = before.project(camera, now.p_WC + distance[:, None] * rays_W)
        far = camera.project(rays_W @ before.R_WC)[0]
        normal = np.tile(normal, (len(SIDE_OFFSETS), 1))
        shift = np.sum((near - far) * normal, axis=1)
        ok = np.isfinite(near).all(axis=1) & np.isfinite(far).all(axis=1) & camera.contains(places, 8.0) & camera.contains(near, 8.0)
        ok &= np.abs(shift) > MIN_SHIFT
        if ok.sum() < MIN_PLACES:
            return None
        places, near, far, normal, shift = places[ok], near[ok], far[ok], normal[ok], shift[ok]
        found, there = self._flow(now.grey, before.grey, places, 0.5 * (near + far))
        again, back = self._flow(before.grey, now.grey, found, places)
        tracked = there & back & (np.linalg.norm(again - places, axis=1) < MAX_RETURN_ERROR)
        if tracked.sum() < MIN_PLACES:
            return None
        share = float(np.median((np.sum((found - far) * normal, axis=1) / shift)[tracked]))
        return True if share > ATTACHED else False if share < APART else None

    @staticmethod
    def _flow(a: np.ndarray, b: np.ndarray, places: np.ndarray, guess: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Track points (n, 2) of image `a` into image `b`; return their pixels and which were found."""
        found, status, _ = cv2.calcOpticalFlowPyrLK(a, b, places.astype(np.float32)[:, None], guess.astype(np.float32)[:, None].copy(),
                                                    winSize=(WINDOW, WINDOW), maxLevel=2, flags=cv2.OPTFLOW_USE_INITIAL_FLOW)
        return found[:, 0].astype(float), status.ravel() > 0
