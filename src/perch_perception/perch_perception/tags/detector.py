"""Detection of tags and of their corners to about 1 px: OpenCV's marker detector on an enlarged frame or a virtual view.

OpenCV only identifies the tags. Its own sub-pixel refinement leaves 0.6 px and a range bias of 6-30 cm at 3 m
(0.06-0.2 px with `tags.refinement`), so it is disabled.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from perch_core.camera import Camera
from perch_core.tag_board import TagBoard
from perch_perception.tags.view import VirtualView

SEARCH_WINDOWS = ((7, 12.0), (31, 7.0))  # threshold windows [px] and how much darker than its mean a tag is [grey values], one per search
VIEW_TAG_SIDE = 60.0          # wanted side of a tag in a virtual view [px]
VIEW_WINDOW = 11              # threshold window there: 1.5 modules of the tag [px]
VIEW_MIN_PERIMETER = 0.1      # perimeter of what may be a tag there, as a share of the view's side: a tenth of a tag's. What is
                              # smaller is texture, and looking at it took three quarters of the time
CUT = 2                       # what dark squares that touch at their corners lose on each side, so that they come apart [px]


@dataclass(frozen=True)
class Detection:
    """Tags of the board in one image.

    Attributes:
        ids: numbers of the tags, ascending; a tag that is seen several times is listed several times.
        corners: pixels of their corners (TL, TR, BR, BL), shape (n, 4, 2), accurate to about 1 px.
        rejected: human-readable reasons why other sightings were not used.
    """

    ids: tuple[int, ...]
    corners: np.ndarray
    rejected: tuple[str, ...] = ()


class TagDetector:
    """Finds the tags of a board. Holds OpenCV's detectors and no state that depends on the images."""

    def __init__(self, board: TagBoard, camera: Camera) -> None:
        self.board, self.camera = board, camera
        self._search = [_detector(board, *window) for window in SEARCH_WINDOWS]
        self._view = _detector(board, VIEW_WINDOW, least=VIEW_MIN_PERIMETER)

    def search(self, image: np.ndarray, turn: int | None = None) -> Detection:
        """Detect tags in the whole frame, enlarged twice; on a board with corner squares also in the frame as it is.

        There `CUT` separates blurred squares that are larger: otherwise only the inner outline of a tag's border is found.

        Args:
            image: mono8, shape (height, width).
            turn: number of this search: successive searches begin with different threshold windows, and end with the first window
                that shows a tag of the board. None: all windows are used.
        """
        frames = [(2.0, cv2.resize(image, None, fx=2.0, fy=2.0, interpolation=cv2.INTER_CUBIC))]
        if self.board.corner_squares:
            frames.append((1.0, image))
        found = list[tuple[np.ndarray, np.ndarray]]()
        for k in range(len(self._search)):
            for scale, frame in frames:
                corners, ids = self._detect(self._search[(k + (turn or 0)) % len(self._search)], frame)
                found.append(((corners - 0.5 * (scale - 1.0)) / scale, ids))  # cv2.resize maps the centre u of a pixel to 2 u + 0.5
            if turn is not None and any(np.isin(ids, self.board.ids).any() for _, ids in found):
                break
        return self._select(found)

    def detect_in_view(self, image: np.ndarray, view: VirtualView, origin: tuple[int, int] = (0, 0)) -> Detection:
        """Detect tags in a virtual view of the image (mono8), or of the part of it that begins at `origin` (column, row).

        Corners are returned in pixels of the camera.
        """
        corners, ids = self._detect(self._view, view.resample(image, self.camera, origin))
        pixels, valid = self.camera.project(view.rays(corners))
        return self._select([(np.where(valid[..., None], pixels, np.nan), ids)])

    def _detect(self, detector: cv2.aruco.ArucoDetector, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return corners (n, 4, 2) in pixels of the image and numbers (n,) of the markers that a detector finds."""
        if self.board.corner_squares:
            image = cv2.dilate(image, np.ones((2 * CUT - 1,) * 2, np.uint8))
        found, ids, _ = detector.detectMarkers(image)
        corners = np.array(found, float).reshape(-1, 4, 2)
        if self.board.corner_squares and len(corners):
            out = corners - corners.mean(axis=1, keepdims=True)
            corners = corners + (CUT - 1) * np.sqrt(2.0) * out / np.linalg.norm(out, axis=2, keepdims=True)
        return corners, np.zeros(0, int) if ids is None else np.ravel(ids)

    def _select(self, found: list[tuple[np.ndarray, np.ndarray]]) -> Detection:
        """Keep markers of the board that lie wholly inside the image; a marker found by several detectors counts once.

        On a board with corner squares its largest outline counts: a smaller one is the inner outline of its border.
        """
        rejected, kept = list[str](), list[tuple[int, np.ndarray]]()
        sightings = [(c, int(n)) for places, ids in found for c, n in zip(places, ids)]
        if self.board.corner_squares:
            sightings.sort(key=lambda sighting: -_side(sighting[0]))
        for corners, number in sightings:
            side = _side(corners)
            if number not in self.board.ids:
                rejected.append(f"tag {number} does not belong to the board")
            elif not np.all(self.camera.contains(corners, margin=1.0)):
                rejected.append(f"tag {number} reaches beyond the image")
            elif not np.isfinite(self.camera.unproject(corners)).all():
                rejected.append(f"tag {number} reaches beyond what the lens's calibration covers")
            elif not any(number == other and np.linalg.norm(corners.mean(axis=0) - c.mean(axis=0)) < 0.5 * side for other, c in kept):
                kept.append((number, corners))
        kept.sort(key=lambda entry: entry[0])
        return Detection(tuple(n for n, _ in kept), np.array([c for _, c in kept]).reshape(-1, 4, 2), tuple(sorted(set(rejected))))


def _side(corners: np.ndarray) -> float:
    """Return the mean side of a tag [px] with corners (4, 2)."""
    return float(np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).mean())


def _detector(board: TagBoard, window: int, darker: float = 7.0, least: float = 0.03) -> cv2.aruco.ArucoDetector:
    """Return OpenCV's detector with a single threshold window [px] (three by default, at three times the cost).

    Contours are used from a perimeter of `least` on, as a share of the image's longer side (OpenCV's default: 0.03).
    """
    parameters = cv2.aruco.DetectorParameters()
    parameters.minMarkerPerimeterRate = least
    parameters.adaptiveThreshWinSizeMin = parameters.adaptiveThreshWinSizeMax = window
    parameters.adaptiveThreshConstant = darker
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE
    parameters.markerBorderBits = board.border
    # Read each module in its middle quarter: near its border the blur mixes neighbours at 3 m.
    parameters.perspectiveRemovePixelPerCell = 8
    parameters.perspectiveRemoveIgnoredMarginPerCell = 0.25
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_APRILTAG_{board.family}"))
    return cv2.aruco.ArucoDetector(dictionary, parameters)
