"""Debug image: features with their trails."""

from __future__ import annotations

import cv2
import numpy as np

from perch_perception.vio.tracker import Features

_TAIL = 8  # frames


class TrackPainter:
    """Draws features with their trails over the last frames; to be called only while the debug image has a subscriber."""

    def __init__(self) -> None:
        self._tails: dict[int, list[np.ndarray]] = {}

    def paint(self, image: np.ndarray, features: Features, landmarks: set[int], caption: str) -> np.ndarray:
        """Draw features onto a frame.

        Args:
            image: grey, uint8 (height, width).
            features: of this frame.
            landmarks: numbers of the features that are landmarks in the filter's state: green; others are yellow, new ones red.
            caption: a line of text.

        Returns:
            bgr, uint8 (height, width, 3).
        """
        out = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
        tails: dict[int, list[np.ndarray]] = {}
        for number, pixel in zip(features.ids.tolist(), features.pixels):
            tail = [*self._tails.get(number, [])[-_TAIL:], pixel]
            tails[number] = tail
            colour = (0, 220, 0) if number in landmarks else (0, 200, 255) if len(tail) > 1 else (0, 0, 255)
            cv2.polylines(out, [np.rint(tail).astype(np.int32).reshape(-1, 1, 2)], False, colour, 1)
            cv2.circle(out, tuple(np.rint(pixel).astype(int).tolist()), 3, colour, 1)
        self._tails = tails
        cv2.putText(out, caption, (8, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1, cv2.LINE_AA)
        return out
