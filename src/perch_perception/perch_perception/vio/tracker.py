"""KLT tracks: pyramidal Lucas-Kanade from frame to frame, predicted by the gyro, checked there and back.

Following a patch from frame to frame adds up its errors: in a hover the map turned by 0.1 deg/s. So a *reference* frame is kept
while the view changes little, and each feature is found again by the patch it had there.

Outliers are found with the known rotation: two tracks then give the direction of translation, and RANSAC over pairs needs
only a few draws.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from perch_core.camera import Camera

from perch_perception.vio.config import TrackerConfig

_DRAWS = 24
# strength (least eigenvalue over 5 x 5 px, as OpenCV scales it) of the corners that unit white noise makes in an image smoothed
# with sigma = 1.5 px: measured on 640 x 480 noise images
_NOISE_CORNER = 1.15e-6


def _noise(image: np.ndarray) -> float:
    """1 sigma of an image's white noise [grey levels], from second differences along some rows."""
    rows = image[::8].astype(np.int16)
    second = 2 * rows[:, 1:-1] - rows[:, :-2] - rows[:, 2:]
    return float(np.median(np.abs(second))) / (0.6745 * np.sqrt(6.0))


@dataclass(frozen=True)
class Features:
    """Features of one frame.

    Attributes:
        ids: numbers, shape (n,); the last `new` of them are new in this frame.
        pixels: shape (n, 2).
        new: how many are new.
        disparity: median motion since the frame before, rotation removed [px]; inf without tracks.
    """

    ids: np.ndarray
    pixels: np.ndarray
    new: int
    disparity: float


class Tracker:
    """Owns the previous frame, the reference frame, and the features in them."""

    def __init__(self, config: TrackerConfig, camera: Camera) -> None:
        self.config, self.camera = config, camera
        self.latest: Features | None = None
        self._previous: np.ndarray | None = None
        self._reference: np.ndarray | None = None
        self._origins: dict[int, np.ndarray] = {}  # pixels of features in the reference frame
        self._pixels, self._ids, self._next = np.zeros((0, 2), np.float32), np.zeros(0, int), 0
        u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
        rays = camera.unproject(np.stack([u, v], axis=-1)[::4, ::4])
        inside = np.nan_to_num(rays[..., 2], nan=-1.0) > np.cos(config.view_angle)
        mask = cv2.resize(inside.astype(np.uint8) * 255, (camera.width, camera.height), interpolation=cv2.INTER_NEAREST)
        border = 8  # a patch at the border has no gradient beyond it
        mask[:border], mask[-border:], mask[:, :border], mask[:, -border:] = 0, 0, 0, 0
        self._view = mask

    def reset(self) -> None:
        """Forget the previous frame; numbers are not used again."""
        self._previous, self._pixels, self._ids = None, np.zeros((0, 2), np.float32), np.zeros(0, int)
        self._reference, self._origins = None, {}

    def track(self, image: np.ndarray, R_now_before: np.ndarray) -> Features:
        """Follow the features into a new frame and refill them.

        Args:
            image: grey, uint8 (height, width).
            R_now_before: rotation of the camera since the frame before, takes rays of then into C of now, (3, 3).
        """
        disparity = np.inf
        noise = _noise(image)
        smooth = cv2.GaussianBlur(image, (0, 0), self.config.smoothing)
        if self._previous is not None and len(self._pixels):
            disparity = self._follow(image, R_now_before)
            self._return_to_reference(image)
            self._thin()
        self._previous = image
        new = 0
        if len(self._pixels) < self.config.features * self.config.refill:
            new = self._refill(smooth, noise)
        self._choose_reference(image)
        self.latest = Features(self._ids, self._pixels.astype(float), new, disparity)
        return self.latest

    def _follow(self, image: np.ndarray, R_now_before: np.ndarray) -> float:
        c, before = self.config, self._pixels
        rays = self.camera.unproject(before.astype(float)) @ R_now_before.T
        guess, valid = self.camera.project(rays)
        guess = np.where(valid[:, None], guess, before).astype(np.float32)
        size, stop = (c.window, c.window), (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 15, 0.03)
        after, found, _ = cv2.calcOpticalFlowPyrLK(
            self._previous, image, before.reshape(-1, 1, 2), guess.reshape(-1, 1, 2).copy(), winSize=size,
            maxLevel=c.levels, criteria=stop, flags=cv2.OPTFLOW_USE_INITIAL_FLOW)
        back, returned, _ = cv2.calcOpticalFlowPyrLK(
            image, self._previous, after, before.reshape(-1, 1, 2).copy(), winSize=size, maxLevel=1, criteria=stop,
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW)
        after = after.reshape(-1, 2)
        place = np.clip(np.nan_to_num(np.rint(after), nan=-1.0, posinf=-1, neginf=-1), 0,
                        [image.shape[1] - 1, image.shape[0] - 1]).astype(int)
        good = ((found.ravel() > 0) & (returned.ravel() > 0) & valid & self.camera.contains(after)
                & (np.linalg.norm(back.reshape(-1, 2) - before, axis=1) < c.back_check)
                & (self._view[place[:, 1], place[:, 0]] > 0))
        good &= self._one_translation(rays, after, good)
        disparity = float(np.median(np.linalg.norm(after - guess, axis=1)[good])) if good.any() else np.inf
        self._pixels, self._ids = after[good], self._ids[good]
        return disparity

    def _return_to_reference(self, image: np.ndarray) -> None:
        """Place features where the patch of the reference frame fits best, if that is close to where they were followed to."""
        index = np.flatnonzero([i in self._origins for i in self._ids.tolist()])
        if self._reference is None or not len(index):
            return
        origins = np.array([self._origins[i] for i in self._ids[index].tolist()], np.float32).reshape(-1, 1, 2)
        guess, size = self._pixels[index].reshape(-1, 1, 2), (self.config.window, self.config.window)
        stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 15, 0.02)
        placed, found, _ = cv2.calcOpticalFlowPyrLK(self._reference, image, origins, guess.copy(), winSize=size, maxLevel=0,
                                                    criteria=stop, flags=cv2.OPTFLOW_USE_INITIAL_FLOW)
        near = (found.ravel() > 0) & (np.linalg.norm(placed - guess, axis=2).ravel() < self.config.reference_reach)
        self._pixels[index[near]] = placed.reshape(-1, 2)[near]

    def _thin(self) -> None:
        """Let go features that have come close to an older one.

        As the vehicle rises, those from the ground draw together under it: at 4 m all of them lay in a spot 15 deg wide, which
        knows height and heading hardly and is out of view at the first fast turn. What goes makes room for others elsewhere.
        """
        least = self.config.crowding * self.config.spacing
        if least <= 0.0 or len(self._pixels) < 2:
            return
        between = np.linalg.norm(self._pixels[:, None] - self._pixels[None], axis=2)
        kept = np.ones(len(self._ids), bool)
        for k in np.flatnonzero((np.tril(between < least, -1)).any(axis=1)):  # numbers increase: older ones come first
            kept[k] = not (between[k, :k] < least)[kept[:k]].any()
        self._pixels, self._ids = self._pixels[kept], self._ids[kept]

    def _choose_reference(self, image: np.ndarray) -> None:
        """Take this frame as the reference when the old one has lost most features or the view has changed too much."""
        shared = [k for k, i in enumerate(self._ids.tolist()) if i in self._origins]
        if self._reference is not None and len(shared) > 0.6 * len(self._ids):
            moves = self._pixels[shared] - np.array([self._origins[self._ids[k]] for k in shared])
            # a common shift leaves the patches alike; spread means that they turn or change their size
            if np.median(np.linalg.norm(moves - np.median(moves, axis=0), axis=1)) < self.config.reference_change:
                return
        self._reference = image
        self._origins = dict(zip(self._ids.tolist(), self._pixels.copy()))

    def _one_translation(self, rays: np.ndarray, after: np.ndarray, good: np.ndarray) -> np.ndarray:
        """Tracks that agree with the translation most of them share, (n,) bool; rays are those before, turned."""
        index = np.flatnonzero(good)
        if len(index) < 8:
            return good
        now = self.camera.unproject(after[index].astype(float))
        normals = np.nan_to_num(np.cross(rays[index], now))  # of the epipolar planes: orthogonal to the translation
        rng = np.random.default_rng(len(index))  # the same draws for the same situation: flights repeat
        pairs = rng.integers(0, len(index), (_DRAWS, 2))
        t = np.cross(normals[pairs[:, 0]], normals[pairs[:, 1]])
        length = np.linalg.norm(t, axis=1, keepdims=True)
        t = np.where(length > 1e-12, t / np.maximum(length, 1e-12), 0.0)
        inliers = np.abs(normals @ t.T) < self.config.epipolar / self.camera.fx
        best = inliers[:, np.argmax(inliers.sum(axis=0) * (length.ravel() > 1e-12))]
        out = np.zeros(len(good), bool)
        out[index[best]] = True
        return out

    def _refill(self, image: np.ndarray, noise: float) -> int:
        """Detect corners away from the features there are; those that noise alone would make are not taken."""
        c, mask = self.config, self._view.copy()
        for x, y in self._pixels:
            cv2.circle(mask, (int(x), int(y)), int(c.spacing), 0, -1)
        corners, strength = cv2.goodFeaturesToTrackWithQuality(
            image, c.features - len(self._pixels), c.quality, c.spacing, mask, blockSize=5)
        if corners is None:
            return 0
        strong = strength.ravel() > c.noise_factor * _NOISE_CORNER * noise**2
        corners = corners.reshape(-1, 2)[strong].astype(np.float32)
        self._pixels = np.concatenate([self._pixels, corners])
        self._ids = np.concatenate([self._ids, np.arange(self._next, self._next + len(corners))])
        self._next += len(corners)
        return len(corners)
