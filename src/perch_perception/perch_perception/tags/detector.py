"""Which tags are in an image and roughly where: OpenCV's marker detector on an enlarged frame or a virtual view.

OpenCV identifies; it does not measure. Its own sub-pixel refinement leaves 0.6 px and a range bias of 6-30 cm at 3 m
(0.06-0.2 px with `tags.refinement`), so it is off.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from perch_core.camera import Camera
from perch_core.tag_board import TagBoard
from perch_perception.tags.view import VirtualView

SEARCH_WINDOWS = (13, 9, 17)  # threshold windows, one per search: each finds tags that the others miss [px]
VIEW_TAG_SIDE = 60.0          # wanted side of a tag in a virtual view [px]
VIEW_WINDOW = 11              # threshold window there: 1.5 modules of the tag [px]
VIEW_LEAST = 0.1              # perimeter of what may be a tag there, as a share of the view's side: a tenth of a tag's. What is
                              # smaller is texture, and looking at it took three quarters of the time


@dataclass(frozen=True)
class Detection:
    """Tags of the board in one image.

    Attributes:
        ids: numbers of the tags, ascending.
        corners: pixels of their corners (TL, TR, BR, BL), shape (n, 4, 2), good to about 1 px.
        rejected: why other sightings were not used, for people.
    """

    ids: tuple[int, ...]
    corners: np.ndarray
    rejected: tuple[str, ...] = ()


class TagDetector:
    """Finds the tags of a board. Holds OpenCV's detectors and nothing that changes with the images."""

    def __init__(self, board: TagBoard, camera: Camera) -> None:
        self.board, self.camera = board, camera
        self._search = [_detector(window) for window in SEARCH_WINDOWS]
        self._view = _detector(VIEW_WINDOW, VIEW_LEAST)

    def search(self, image: np.ndarray, turn: int = 0) -> Detection:
        """Look for tags in the whole frame, enlarged twice.

        Args:
            image: mono8, shape (height, width).
            turn: number of this search; successive searches use different threshold windows.
        """
        large = cv2.resize(image, None, fx=2.0, fy=2.0, interpolation=cv2.INTER_CUBIC)
        corners, ids, _ = self._search[turn % len(self._search)].detectMarkers(large)
        # cv2.resize maps the centre u of a pixel to 2 u + 0.5
        return self._select([(np.reshape(c, (4, 2)) - 0.5) / 2.0 for c in corners], ids)

    def look(self, image: np.ndarray, view: VirtualView, origin: tuple[int, int] = (0, 0)) -> Detection:
        """Look for tags in a virtual view of the image (mono8), or of the part of it that begins at `origin` (column, row).

        Corners are returned in pixels of the camera.
        """
        corners, ids, _ = self._view.detectMarkers(view.resample(image, self.camera, origin))
        found = []
        for corner in corners:
            pixels, valid = self.camera.project(view.rays(np.reshape(corner, (4, 2))))
            found.append(np.where(valid[:, None], pixels, np.nan))
        return self._select(found, ids)

    def _select(self, corners: list[np.ndarray], ids: np.ndarray | None) -> Detection:
        """Keep what belongs to the board: known numbers, each once, wholly inside the image."""
        numbers = [] if ids is None else [int(i) for i in np.ravel(ids)]
        rejected, kept = [], {}
        for number in sorted(set(numbers)):
            places = [c for c, n in zip(corners, numbers) if n == number]
            if number not in self.board.ids:
                rejected.append(f"tag {number} does not belong to the board")
            elif len(places) > 1:
                # which one is ours cannot be known; the other tags decide
                rejected.append(f"tag {number} is seen {len(places)} times")
            elif not np.all(self.camera.contains(places[0], margin=1.0)):
                rejected.append(f"tag {number} reaches beyond the image")
            else:
                kept[number] = places[0]
        return Detection(tuple(kept), np.array(list(kept.values())).reshape(-1, 4, 2), tuple(rejected))


def _detector(window: int, least: float = 0.03) -> cv2.aruco.ArucoDetector:
    """OpenCV's detector with a single threshold window [px] (three by default, at three times the cost).

    Contours are followed up from a perimeter of `least`, as a share of the image's longer side (OpenCV's own: 0.03).
    """
    parameters = cv2.aruco.DetectorParameters()
    parameters.minMarkerPerimeterRate = least
    parameters.adaptiveThreshWinSizeMin = parameters.adaptiveThreshWinSizeMax = window
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE
    # Read each module in its middle quarter: near its border the blur mixes neighbours at 3 m.
    parameters.perspectiveRemovePixelPerCell = 8
    parameters.perspectiveRemoveIgnoredMarginPerCell = 0.25
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    return cv2.aruco.ArucoDetector(dictionary, parameters)
