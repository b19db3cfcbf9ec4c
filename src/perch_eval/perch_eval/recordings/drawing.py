"""Pictures for a report: detections drawn onto images, and a gallery that samples a stream of unknown length."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import cv2
import numpy as np

from perch_core import so3
from perch_core.camera import Camera
from perch_core.tag_board import TagBoard
from perch_core.values import TargetPose
from perch_perception.line_mapping import LineSighting

BOARD, TAG, WIRE, TEXT = (0, 220, 0), (0, 160, 255), (255, 80, 0), (255, 255, 255)
AXES = ((0, 0, 255), (0, 255, 0), (255, 0, 0))  # s1 red, s2 green, s3 blue


def canvas(pixels: np.ndarray) -> np.ndarray:
    """A copy of an image in bgr."""
    return cv2.cvtColor(pixels, cv2.COLOR_GRAY2BGR) if pixels.ndim == 2 else pixels.copy()


def draw_board(image: np.ndarray, camera: Camera, board: TagBoard, pose: TargetPose, ids: Iterable[int]) -> None:
    """Draw the outlines of the used tags and the axes of S at a pose."""
    R = so3.quat_to_matrix(pose.q_WS)
    for number, corners_S in zip(board.ids, board.corners_S):
        if number in set(ids):
            edges = np.concatenate([a + np.linspace(0.0, 1.0, 8)[:, None] * (b - a) for a, b in zip(corners_S, np.roll(corners_S, -1, 0))])
            _line(image, camera.project(edges @ R.T + pose.p_WS)[0], BOARD, closed=True)
    extent = 0.5 * min(board.pad_size)
    for axis, colour in zip(np.eye(3), AXES):
        _line(image, camera.project(np.outer(np.linspace(0.0, extent, 8), axis) @ R.T + pose.p_WS)[0], colour)


def draw_tags(image: np.ndarray, tags: Sequence[tuple[int, np.ndarray]]) -> None:
    """Draw tags, given by number and corners [px], shape (4, 2)."""
    for number, corners in tags:
        _line(image, corners, TAG, closed=True)
        cv2.circle(image, _whole(corners[0]), 3, TAG, -1)
        _text(image, str(number), _whole(corners.mean(axis=0)), TAG)


def draw_wires(image: np.ndarray, camera: Camera, wires: Sequence[LineSighting]) -> None:
    """Draw detected wires."""
    for wire in wires:
        _line(image, camera.project(wire.rays_C)[0], WIRE)


def caption(image: np.ndarray, text: str) -> np.ndarray:
    """Write a line of text onto an image and return it."""
    _text(image, text, (8, 18), TEXT)
    return image


def _text(image: np.ndarray, text: str, place: tuple[int, int], colour: tuple[int, int, int]) -> None:
    for ink, width in (((0, 0, 0), 3), (colour, 1)):
        cv2.putText(image, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.5, ink, width, cv2.LINE_AA)


def _whole(pixel: np.ndarray) -> tuple[int, int]:
    return tuple(np.rint(pixel).astype(int).tolist())


def _line(image: np.ndarray, pixels: np.ndarray, colour: tuple[int, int, int], closed: bool = False) -> None:
    if len(pixels) and np.isfinite(pixels).all() and np.abs(pixels).max() < 1e5:
        cv2.polylines(image, [np.rint(16 * pixels).astype(np.int32)], closed, colour, 1, cv2.LINE_AA, 4)


class Shown(NamedTuple):
    """A picture.

    Attributes:
        stamp: of the image [ns].
        caption: what it shows.
        pixels: bgr, uint8 (height, width, 3).
    """

    stamp: int
    caption: str
    pixels: np.ndarray


class Gallery:
    """Keeps every n-th picture that is offered; when it is full, every other one is dropped and n is doubled.

    Attributes:
        shown: the pictures, in their order.
    """
    def __init__(self, most: int = 12) -> None:
        self.shown: list[Shown] = []
        self._most, self._step, self._offered = most, 1, 0

    def due(self, within: int = 1) -> bool:
        """Return whether one of the next `within` pictures will be kept."""
        return -self._offered % self._step < within

    def offer(self, draw: Callable[[], Shown | None]) -> None:
        """Draw and keep the next picture, if it is due and available."""
        picture = draw() if self.due() else None
        self._offered += 1
        if picture is None:
            return
        self.shown.append(picture)
        if len(self.shown) >= self._most:
            self.shown, self._step = self.shown[::2], 2 * self._step
