"""KLT tracks: pyramidal Lucas-Kanade from frame to frame, predicted by the gyro, with a forward-backward check.

Tracking a patch from frame to frame accumulates errors: in a hover the map turned by 0.1 deg/s. A *reference* frame is therefore
kept while the view changes little, and each feature is located again by its patch in that frame.

Brightness that is fixed in the image while the scene moves, above all the lens's vignetting, biases every track towards
standstill: by pixels over a floor of low contrast, all in the same direction. Patches are therefore compared after the local mean
brightness is subtracted (`flattened`).

Outliers are found with the known rotation: two tracks then give the direction of translation, and RANSAC over pairs needs
only a few draws.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from perch_core import so3
from perch_core.camera import Camera

from perch_perception.vio.bearing import observe
from perch_perception.vio.config import TrackerConfig

_REFILL = 0.85  # new features are detected below this share of those to keep up
_SPACING = 18.0  # least distance between features [px]
_CROWDING = 0.6  # features nearer to an older one than this share of the spacing are let go
_FLATTEN = 20.0  # sigma over which brightness is averaged and taken off (vignetting, shadows) [px]
_QUALITY = 0.01  # least corner strength, share of the strongest
_NOISE_FACTOR = 8.0  # the same, in corners that noise alone makes
_WINDOW = 21  # side of the tracked patch [px]
_LEVELS = 3  # pyramid levels above the image
_REFERENCE_CHANGE = 8.0  # motion apart that asks for a new reference [px]
_SMOOTHING = 1.5  # sigma of the smoothing before detection [px]
_REACH = 1.5  # largest correction by the reference frame's patch [px]
_RETURNS = 0.7  # tracking there and back ends this close [px]
_EPIPOLAR = 2.0  # largest distance from the epipolar plane [px]
_VIEW = 1.40  # features beyond this from the axis are not used [rad]
_DRAWS = 24
_STOP = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 15, 0.03)
# the way back begins where it should end, and is judged at 0.7 px: stopping as on the way there cost a tenth of VIO, and gave nothing
_CHECK = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 10, 0.1)
_HALVING = 1.0  # sigma of the smoothing in cv2.pyrDown [px]
# strength (least eigenvalue over 3 x 3 px, as OpenCV scales it) of the corners that unit white noise makes in an image of half
# the size, smoothed with sigma = 1.5 px before: measured on 640 x 480 images of 5 grey levels of noise
_NOISE_CORNER = 2.3e-6
_KLT_EIGENVALUE = 1024.0  # least eigenvalue of the mean of g g^T over a patch, in what OpenCV's KLT gives for it
# unit white noise in OpenCV's gradients, [-1 0 1]/2 along an axis and [3 10 3]/16 across it: variance, and how much of it the least
# eigenvalue scatters from patch to patch (measured in images of noise alone)
_NOISE_GRADIENT, _NOISE_SCATTER = (0.5**2 + 0.5**2) * (3**2 + 10**2 + 3**2) / 16**2, 0.08
_ROUNDING = 12**-0.5  # 1 sigma of the rounding to grey levels
_FLAT_STEP, _MID_GREY = 8, 128.0  # the average is taken in an image of 1 / step the size


def _noise(image: np.ndarray, original: np.ndarray | None = None) -> float:
    """Return 1 sigma of an image's white noise [grey levels], from second differences in some rows (Immerkaer 1996).

    Pixels that are clipped, in the image or in the camera's `original` of it, do not show the noise. Where all are, or where camera
    or compression have smoothed the noise away, that of the rounding to grey levels is left.
    """
    rows = _three_rows(image).astype(np.int16)
    across = rows[0] - 2 * rows[1] + rows[2]
    second = across[:, :-2] - 2 * across[:, 1:-1] + across[:, 2:]
    clipped = np.any([(part == 0) | (part == 255) for part in (rows, _three_rows(image if original is None else original))], axis=(0, 1))
    shown = second[~(clipped[:, :-2] | clipped[:, 1:-1] | clipped[:, 2:])]
    return max(float(np.median(np.abs(shown))) / (0.6745 * 6.0), _ROUNDING) if len(shown) else _ROUNDING


def _three_rows(image: np.ndarray) -> np.ndarray:
    """Return every sixteenth row of an image and the two below it, shape (3, n, width)."""
    return np.array([image[k : image.shape[0] - 2 + k : 16] for k in range(3)])


def flattened(image: np.ndarray) -> np.ndarray:
    """Return an image minus its local mean brightness, around mid-grey; uint8 (height, width)."""
    small = cv2.resize(image, None, fx=1 / _FLAT_STEP, fy=1 / _FLAT_STEP, interpolation=cv2.INTER_AREA)
    surroundings = cv2.resize(cv2.GaussianBlur(small, (0, 0), _FLATTEN / _FLAT_STEP), image.shape[::-1])
    return cv2.addWeighted(image, 1.0, surroundings, -1.0, _MID_GREY)


@dataclass(frozen=True)
class Features:
    """Features of one frame.

    Attributes:
        ids: numbers, shape (n,); the last `new` of them are new in this frame.
        pixels: shape (n, 2).
        new: how many are new.
        sigma: 1 sigma of each patch's fit by the image's noise [px], shape (n,).
    """

    ids: np.ndarray
    pixels: np.ndarray
    new: int
    sigma: np.ndarray


class Tracker:
    """KLT tracker: owns the previous frame, the reference frame, and the features in them."""

    def __init__(self, config: TrackerConfig, camera: Camera) -> None:
        self.config, self.camera = config, camera
        self.latest: Features | None = None
        self._previous: np.ndarray | None = None
        self._reference: np.ndarray | None = None
        self._origins: dict[int, np.ndarray] = {}  # pixels of features in the reference frame
        self._pixels, self._ids, self._next = np.zeros((0, 2), np.float32), np.zeros(0, int), 0
        u, v = np.meshgrid(np.arange(0.0, camera.width, 4.0), np.arange(0.0, camera.height, 4.0))
        rays = camera.unproject(np.stack([u, v], axis=-1))
        # beyond its calibration a lens has no rays: 4 px of the grid, and `_REACH`
        in_view, has_ray = (cv2.resize(part.astype(np.uint8) * 255, (camera.width, camera.height), interpolation=cv2.INTER_NEAREST)
                            for part in (np.nan_to_num(rays[..., 2], nan=-1.0) > np.cos(_VIEW), np.isfinite(rays[..., 2])))
        mask = cv2.bitwise_and(in_view, cv2.erode(has_ray, np.ones((13, 13), np.uint8)))
        border = 8  # a patch at the border has no gradient beyond it
        mask[:border], mask[-border:], mask[:, :border], mask[:, -border:] = 0, 0, 0, 0
        self._view = mask

    def reset(self) -> None:
        """Discard all frames and features; feature numbers are not reused."""
        self._previous, self._pixels, self._ids = None, np.zeros((0, 2), np.float32), np.zeros(0, int)
        self._reference, self._origins = None, {}

    def track(self, image: np.ndarray, R_now_before: np.ndarray, slack: float = 0.0) -> Features:
        """Track the features into a new frame, and detect new ones where too few are left.

        Args:
            image: grey, uint8 (height, width).
            R_now_before: rotation of the camera from C of the previous frame into C of the new one, shape (3, 3).
            slack: bound of its error [rad].
        """
        original, image = image, flattened(image)
        if self._previous is not None and len(self._pixels):
            self._follow(self._previous, image, R_now_before, slack)
            self._return_to_reference(image)
            self._thin()
        self._previous, noise = image, _noise(image, original)
        new = 0
        if len(self._pixels) < self.config.features * _REFILL:
            new = self._refill(image, noise)
        self._choose_reference(image)
        self.latest = Features(self._ids, self._pixels.astype(float), new, self._fit_sigma(image, noise))
        return self.latest

    def _follow(self, previous: np.ndarray, image: np.ndarray, R_now_before: np.ndarray, slack: float) -> None:
        rays = observe(self.camera, self._pixels).b_C @ R_now_before.T
        guess, valid = self.camera.project(rays)
        # what has left the view would be searched for longest
        kept = valid & self.camera.contains(guess, -_WINDOW)
        before, ids, rays, guess = self._pixels[kept], self._ids[kept], rays[kept], guess[kept].astype(np.float32)
        after, found = self._search(previous, image, before, guess, _LEVELS)
        place = np.clip(np.nan_to_num(np.rint(after), nan=-1.0, posinf=-1, neginf=-1), 0,
                        [image.shape[1] - 1, image.shape[0] - 1]).astype(int)
        good = found & self.camera.contains(after) & (self._view[place[:, 1], place[:, 0]] > 0)
        back, returned = self._search(image, previous, after[good], before[good], 0, _CHECK)
        good[good] = returned & (np.linalg.norm(back - before[good], axis=1) < _RETURNS)
        good &= self._one_translation(rays, after, good, slack)
        self._pixels, self._ids = after[good], ids[good]

    def _search(self, source: np.ndarray, image: np.ndarray, pixels: np.ndarray, guess: np.ndarray,
                levels: int, stop: tuple[int, int, float] = _STOP) -> tuple[np.ndarray, np.ndarray]:
        """Locate the patches of a source image at pixels (n, 2) in an image, from a guess (n, 2); return pixels and success."""
        if not len(pixels):
            return np.zeros((0, 2), np.float32), np.zeros(0, bool)
        found_at, found, _ = cv2.calcOpticalFlowPyrLK(
            source, image, pixels.reshape(-1, 1, 2), guess.reshape(-1, 1, 2).copy(), winSize=(_WINDOW,) * 2,
            maxLevel=levels, criteria=stop, flags=cv2.OPTFLOW_USE_INITIAL_FLOW)
        return found_at.reshape(-1, 2), found.ravel() > 0

    def _return_to_reference(self, image: np.ndarray) -> None:
        """Move features to the best fit of their patch in the reference frame, where that is close to the tracked pixel."""
        index = np.flatnonzero([i in self._origins for i in self._ids.tolist()])
        if self._reference is None or not len(index):
            return
        origins = np.array([self._origins[i] for i in self._ids[index].tolist()], np.float32)
        placed, found = self._search(self._reference, image, origins, self._pixels[index], 0)
        near = found & (np.linalg.norm(placed - self._pixels[index], axis=1) < _REACH)
        self._pixels[index[near]] = placed[near]

    def _thin(self) -> None:
        """Drop features that have come close to an older one.

        As the vehicle climbs, ground features from the start converge under it: at 4 m all of them lay within 15 deg, which
        hardly determines height and heading and leaves the view at the first fast turn. Dropping some makes room for features
        elsewhere.
        """
        least = _CROWDING * _SPACING
        if len(self._pixels) < 2:
            return
        u, v = (x[:, None] - x for x in self._pixels.T)
        close = np.tril(np.sqrt(u * u + v * v) < least, -1)  # numbers increase: older ones come first
        kept = np.ones(len(self._ids), bool)
        for k in np.flatnonzero(close.any(axis=1)):
            kept[k] = not close[k, kept].any()
        self._pixels, self._ids = self._pixels[kept], self._ids[kept]

    def _choose_reference(self, image: np.ndarray) -> None:
        """Take this frame as the reference when the old one has lost most features or the view has changed too much."""
        shared = [k for k, i in enumerate(self._ids.tolist()) if i in self._origins]
        if self._reference is not None and len(shared) > 0.6 * len(self._ids):
            moves = self._pixels[shared] - np.array([self._origins[self._ids[k]] for k in shared])
            # a common shift leaves the patches alike; spread means that they turn or change their size
            if np.median(np.linalg.norm(moves - np.median(moves, axis=0), axis=1)) < _REFERENCE_CHANGE:
                return
        self._reference = image
        self._origins = dict(zip(self._ids.tolist(), self._pixels.copy()))

    def _one_translation(self, rays: np.ndarray, after: np.ndarray, good: np.ndarray, slack: float) -> np.ndarray:
        """Return the tracks that agree with the translation shared by most of them, (n,) bool.

        `rays` are those of the previous frame, rotated into the new one with an error of up to `slack` [rad].
        """
        index = np.flatnonzero(good)
        if len(index) < 8:
            return good
        now = observe(self.camera, after[index]).b_C
        normals = np.nan_to_num(so3.cross(rays[index], now))  # of the epipolar planes: orthogonal to the translation
        rng = np.random.default_rng(len(index))  # the same draws for the same situation: flights repeat
        pairs = rng.integers(0, len(index), (_DRAWS, 2))
        t = so3.cross(normals[pairs[:, 0]], normals[pairs[:, 1]])
        length = np.linalg.norm(t, axis=1, keepdims=True)
        t = np.where(length > 1e-12, t / np.maximum(length, 1e-12), 0.0)
        inliers = np.abs(normals @ t.T) < _EPIPOLAR / self.camera.fx + slack
        best = inliers[:, np.argmax(inliers.sum(axis=0) * (length.ravel() > 1e-12))]
        out = np.zeros(len(good), bool)
        out[index[best]] = True
        return out

    def _fit_sigma(self, image: np.ndarray, noise: float) -> np.ndarray:
        """Return 1 sigma of the least squares fit of each feature's patch, along its least certain axis [px], shape (n,).

        sigma^2 = sigma_n^2 / lambda_min(sum g g^T), with sigma_n the image's noise [grey levels] and g the gradients over the
        patch [grey levels/px] (Foerstner and Guelch 1987), less the contribution of the noise itself to g g^T. Where the image
        contains only noise, the scatter of that contribution bounds sigma.
        """
        if not len(self._pixels):
            return np.zeros(0)
        # KLT has the matrix; from an image to itself there is nothing to search for
        _, _, least = cv2.calcOpticalFlowPyrLK(  # type: ignore[call-overload]
            image, image, self._pixels.reshape(-1, 1, 2), None, winSize=(_WINDOW,) * 2, maxLevel=0,
            flags=cv2.OPTFLOW_LK_GET_MIN_EIGENVALS)
        of_noise = _NOISE_GRADIENT * noise**2
        of_scene = _KLT_EIGENVALUE * least.ravel().astype(float) - of_noise
        return noise / np.sqrt(_WINDOW**2 * np.maximum(of_scene, _NOISE_SCATTER * of_noise))

    def _refill(self, image: np.ndarray, noise: float) -> int:
        """Detect corners away from existing features, except those that noise alone would produce; return their number.

        Detection runs at half the resolution: the smoothing leaves no finer detail, and the cost is a quarter.
        """
        mask = self._view[::2, ::2].copy()
        for x, y in self._pixels:
            cv2.circle(mask, (round(x / 2), round(y / 2)), int(_SPACING / 2), 0, -1)
        half = cv2.pyrDown(image)
        half = cv2.GaussianBlur(half, (0, 0), 0.5 * np.sqrt(_SMOOTHING**2 - _HALVING**2))
        corners, strength = cv2.goodFeaturesToTrackWithQuality(
            half, self.config.features - len(self._pixels), _QUALITY, _SPACING / 2, mask, blockSize=3)
        if corners is None:
            return 0
        strong = strength.ravel() > _NOISE_FACTOR * _NOISE_CORNER * noise**2
        corners = 2.0 * corners.reshape(-1, 2)[strong].astype(np.float32)
        self._pixels = np.concatenate([self._pixels, corners])
        self._ids = np.concatenate([self._ids, np.arange(self._next, self._next + len(corners))])
        self._next += len(corners)
        return len(corners)
