"""Board poses from a sequence of images: search, then track. [M:sec. IV-B]

Searching the whole enlarged frame takes 10 ms and is done at 10 Hz. Once the board is known, its tags are detected in a virtual
view aimed at its predicted place, which takes 3 ms and finds small and slanted tags. Between these detections, which read
the tags' numbers again, the expected corners are accurate enough to measure the edges directly.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from perch_core.camera import Region
from perch_core.camera_mount import CameraMount
from perch_core.sensors import CalibrationSigmas
from perch_core.tag_board import TagBoard
from perch_perception.pose_buffer import BodyState
from perch_perception.tags.average import average_board
from perch_perception.tags.consensus import consistent
from perch_perception.tags.detector import VIEW_TAG_SIDE, Detection, TagDetector
from perch_perception.tags.pose import BoardPose, LocalizationRefusal, solve_board
from perch_perception.tags.refinement import refine_corners
from perch_perception.tags.view import GRID, MAX_SIDE, VirtualView

SEARCH_PERIOD = 0.1  # between searches of the whole frame, 10 ms each [s]
LOST_AFTER = 0.4   # tracking without a tag before searching [s]
MIN_RANGE = 0.15   # a nearer board is taken for one of another size [m]
MAX_TRACKED_IMAGES = 4  # in a row in which the expected corners are measured without reading the tags' numbers
VIEW_MARGIN = 1.2  # what is looked at around the pad, in pad sizes
LARGEST_VIEW = 2048  # side of a view, also where the wanted size of tags demands more: 4 MB [px]
PRINT_SIGMA = 0.0002  # of a tag's place on the board, per axis: what plotters and careful gluing keep [m]
MAX_TRACK_GAP = 0.1   # time since the last sighting over which corners are expected well enough [s]
MIN_TRACKED_TAGS = 3  # so many tags must be expected: their agreement shows that nothing else was measured
EXPECTED_MARGIN = 6.0  # an expected corner this near to the border may be outside [px]
AROUND_VIEW = 12      # what is looked at beyond the view: profiles across edges at its border [px]
MIN_BRANCH_GAP = 50.0  # chi^2 to the second-best pose of a sighting that can be tracked


@dataclass(frozen=True)
class Localization:
    """Result of one image.

    Attributes:
        board: joint pose in the camera, or None.
        average: the paper's averaged pose, where it is enabled, all tags were seen and each has a pose; else None.
        complete: all tags of the board were used.
        searched: the whole frame was searched.
        message: human-readable description of what is missing or was refused; empty otherwise.
    """

    board: BoardPose | None
    average: BoardPose | None = None
    complete: bool = False
    searched: bool = False
    message: str = ""


@dataclass(frozen=True)
class _Part:
    """A region of an image, mono8, and the column and row at which it begins."""

    pixels: np.ndarray
    origin: tuple[int, int]

    @classmethod
    def of(cls, image: np.ndarray | Callable[[Region], np.ndarray], region: Region) -> _Part:
        whole = image(region) if callable(image) else image
        return cls(whole[region], (region[1].start, region[0].start))


class BoardLocalizer:
    """Search and tracking of one board in the images of one camera.

    Args:
        board: geometry of the tags.
        mount: the camera.
        max_range: a board further away than this is refused as one of another size [m].
        averaging: whether to compute the paper's average as well.
        calibration: uncertainty of the lens.
    """

    def __init__(self, board: TagBoard, mount: CameraMount, max_range: float = 6.0,
                 averaging: bool = False, calibration: CalibrationSigmas = CalibrationSigmas()) -> None:
        self.board, self.mount = board, mount
        self._max_range, self._averaging = max_range, averaging
        self._lens_sigma = calibration.lens
        self._detector = TagDetector(board, mount.camera)
        self._tag_size = float(np.median(np.linalg.norm(board.corners_S[:, 0] - board.corners_S[:, 1], axis=-1)))
        self._radius = float(np.linalg.norm(board.corners_S, axis=-1).max())
        # Side [px] of a view in which tags have the wanted size while the board is seen under a half angle of at most 45 deg.
        side = 2.0 * VIEW_MARGIN * VIEW_TAG_SIDE * self._radius / self._tag_size / math.cos(math.radians(45.0))
        self._max_side = max(MAX_SIDE, min(GRID * math.ceil(side / GRID), LARGEST_VIEW))
        self._last: BoardPose | None = None       # last sighting ...
        self._last_body: BodyState | None = None  # ... where the vehicle was then ...
        self._last_time = -np.inf                 # ... and when
        self._search_time = -np.inf
        self._searches = 0
        self._tracked_images = 0                  # images since the numbers were read

    def process(self, image: np.ndarray | Callable[[Region], np.ndarray], time: float, body: BodyState | None = None) -> Localization:
        """Localise the board.

        Args:
            image: mono8, shape (height, width); or a function that returns an image which is valid in a given region: while a
                board is tracked only its surroundings are read, and between searches nothing is.
            time: middle of the exposure [s]; must grow from image to image.
            body: state of the vehicle at that time; only used to predict the board's pose.

        Returns:
            The sighting; `board` is None where there is none, and `message` gives the reason.
        """
        last = self._last
        if last is not None and time - self._last_time <= LOST_AFTER:
            p_CS, R_CS = self._predict(last, body)
            view = self._aim(p_CS, self._radius)
            part = _Part.of(image, view.region(self.mount.camera, AROUND_VIEW))
            tracked = self._track(part, time, body, p_CS, R_CS) if last.branch_gap >= MIN_BRANCH_GAP else None
            if tracked is None:
                self._tracked_images = 0
            result = tracked or self._attempt(part, self._detect_in_view(part, view), (p_CS, R_CS), False)
        elif time - self._search_time < SEARCH_PERIOD - 1e-3:
            return Localization(None, message="waiting for the next search")
        else:
            self._search_time, self._tracked_images = time, 0
            camera = self.mount.camera
            whole = _Part.of(image, (slice(0, camera.height), slice(0, camera.width)))
            result = self._attempt(whole, self._search(whole), None, True)
        if result.board is not None:
            self._last, self._last_body, self._last_time = result.board, body, time
        return result

    def _attempt(self, part: _Part, detection: Detection, expected: tuple[np.ndarray, np.ndarray] | None,
                 searched: bool) -> Localization:
        """Solve for a detection; a refusal becomes the message."""
        try:
            return self._solve(part, detection, expected, searched)
        except LocalizationRefusal as refusal:
            return Localization(None, searched=searched, message="; ".join([str(refusal), *detection.rejected]))

    def _track(self, part: _Part, time: float, body: BodyState | None, p_CS: np.ndarray,
                R_CS: np.ndarray) -> Localization | None:
        """Measure the corners where they are expected; None where this is not reliable, or where a corner is not found."""
        if (self._tracked_images >= MAX_TRACKED_IMAGES or body is None or self._last_body is None
                or time - self._last_time > MAX_TRACK_GAP):
            return None
        pixels, valid = self.mount.camera.project(self.board.corners_S @ R_CS.T + p_CS)
        inside = np.all(valid & self.mount.camera.contains(pixels, margin=EXPECTED_MARGIN), axis=1)
        ids = tuple(number for number, seen in zip(self.board.ids, inside) if seen)
        if len(ids) < MIN_TRACKED_TAGS:
            return None
        try:
            result = self._solve(part, Detection(ids, pixels[inside]), (p_CS, R_CS), False, start=(p_CS, R_CS))
        except LocalizationRefusal:
            return None
        if result.message:
            return None  # an edge was not found, or tags disagree: detect them again
        self._tracked_images += 1
        return result

    def _search(self, whole: _Part) -> Detection:
        """Search the frame, then detect tags again in a virtual view around those found, which may show more."""
        first = self._resolve_duplicates(self._detector.search(whole.pixels, self._searches))
        self._searches += 1
        if not first.ids:
            return first
        rays = self.mount.camera.unproject(first.corners)
        angles = np.linalg.norm(rays - np.roll(rays, -1, axis=1), axis=2).max(axis=1)
        distance = self._tag_size / float(np.median(angles))
        direction = rays.reshape(-1, 3).mean(axis=0)
        seen = [self.board.ids.index(number) for number in first.ids]
        centre_S = self.board.corners_S[seen].reshape(-1, 3).mean(axis=0)
        radius = float(np.linalg.norm(self.board.corners_S - centre_S, axis=-1).max())
        closer = self._resolve_duplicates(self._detect_in_view(whole, self._aim(distance * direction / np.linalg.norm(direction), radius)))
        best = closer if len(closer.ids) >= len(first.ids) else first
        rejected = tuple(dict.fromkeys(first.rejected + closer.rejected))
        return Detection(best.ids, best.corners, rejected)

    def _resolve_duplicates(self, detection: Detection, expected: tuple[np.ndarray, np.ndarray] | None = None) -> Detection:
        """Keep each tag once: of several sightings the one that agrees with the others, or with the board's expected pose."""
        twice = sorted({i for i in detection.ids if detection.ids.count(i) > 1})
        if not twice:
            return detection
        numbers = np.array([self.board.ids.index(i) for i in detection.ids])
        chosen = consistent(self.mount.camera, self.board.corners_S, numbers, detection.corners, expected)
        notes = tuple(f"tag {i} is seen {detection.ids.count(i)} times" for i in twice)
        return Detection(tuple(detection.ids[k] for k in chosen), detection.corners[chosen], detection.rejected + notes)

    def _detect_in_view(self, part: _Part, view: VirtualView) -> Detection:
        return self._detector.detect_in_view(part.pixels, view, part.origin)

    def _aim(self, p_CS: np.ndarray, radius: float) -> VirtualView:
        """Return the view of the board's expected surroundings, `radius` [m] around p_CS."""
        distance = float(np.linalg.norm(p_CS))
        share = min(VIEW_MARGIN * radius / max(distance, 1e-3), 0.95)
        return VirtualView.aim(p_CS, float(np.arcsin(share)), VIEW_TAG_SIDE * distance / self._tag_size, self._max_side)

    def _predict(self, last: BoardPose, body: BodyState | None) -> tuple[np.ndarray, np.ndarray]:
        """Predict the board's pose, p_CS and R_CS: the board is fixed in the map while the vehicle moves."""
        p, R = last.p_CS, last.R_CS
        if body is None or self._last_body is None:
            return p, R
        then, now = self._last_body, body
        p_WC, R_WC = self.mount.pose(then.p_WB, then.R_WB)
        p_WC_now, R_WC_now = self.mount.pose(now.p_WB, now.R_WB)
        return R_WC_now.T @ (p_WC + R_WC @ p - p_WC_now), R_WC_now.T @ R_WC @ R

    def _solve(self, part: _Part, detection: Detection, expected: tuple[np.ndarray, np.ndarray] | None, searched: bool,
               start: tuple[np.ndarray, np.ndarray] | None = None) -> Localization:
        """Refine the corners and solve for the pose, from `start` (p_CS, R_CS) where that is known.

        `expected` is the pose at which the board should be.

        Raises:
            LocalizationRefusal: no usable tag, or no plausible pose.
        """
        if not detection.ids:
            raise LocalizationRefusal("no tag of the board found")
        detection, camera = self._resolve_duplicates(detection, expected), self.mount.camera
        notes, ids = list(detection.rejected), detection.ids
        if not ids:
            raise LocalizationRefusal("every tag of the board that is found is seen several times, and no two sightings agree")
        refined = refine_corners(part.pixels, camera, detection.corners, origin=part.origin, modules=self.board.modules)
        blurred = [i for i, measured in zip(ids, refined.measured) if not measured.all()]
        if blurred:
            notes.append(f"the edges of tags {blurred} cannot be measured")
            if start is not None:  # these are not detected, only expected
                raise LocalizationRefusal(notes[-1])
        corners_S, rays, sigma = self.board.corners_S[[self.board.ids.index(i) for i in ids]], refined.rays_C, refined.sigma
        pose = solve_board(camera, corners_S, rays, sigma, ids, None if expected is None else expected[1], start, self._lens_sigma,
                           PRINT_SIGMA)
        distance = float(np.linalg.norm(pose.p_CS))
        if not MIN_RANGE <= distance <= self._max_range:
            raise LocalizationRefusal(
                f"the tags' size puts the board at {distance:.2f} m, outside "
                f"[{MIN_RANGE:g}, {self._max_range:g}] m: not a board of this size")
        complete = len(pose.ids) == len(self.board.ids)
        average = None
        if self._averaging and complete:
            try:
                average = average_board(camera, corners_S, rays, ids)
            except LocalizationRefusal as refusal:
                notes.append(f"no average: {refusal}")
        if pose.dropped:
            notes.append(f"tags {list(pose.dropped)} contradict the others")
        return Localization(pose, average, complete, searched, "; ".join(notes))
