"""Detections in images: of tags, wires and the board in single ones, without an IMU; drawn onto images, and kept in galleries."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from perch_core import so3
from perch_core.camera import Camera, PinholeCamera
from perch_core.camera_mount import CameraMount
from perch_core.tag_board import FAMILIES, Tag, TagBoard
from perch_core.values import CameraImage, TargetPose
from perch_perception.images import mono_image, rgb_image
from perch_perception.line_mapping import LineDetectionConfig, LineSighting, detect_lines
from perch_perception.tags import BoardLocalizer, BoardPose, Localization, TagDetector, refine_corners

GUESSED_FOCAL = 0.8  # of a camera without calibration, as a share of the image's width
BOARD, TAG, WIRE, TEXT = (0, 220, 0), (0, 160, 255), (255, 80, 0), (255, 255, 255)
AXES = ((0, 0, 255), (0, 255, 0), (255, 0, 0))  # s1 red, s2 green, s3 blue
GalleryImage = tuple[str, np.ndarray]
"""What the image shows, and its pixels, bgr, uint8 (height, width, 3)."""


@dataclass(frozen=True)
class ImageDetections:
    """Detections in one image.

    Attributes:
        tags: numbers and corners [px], shape (4, 2), of all tags of the family.
        board: pose of the board in the camera; None: it was not found.
        message: reason why it was not found.
        wires: arcs of straight wires.
        mount: the camera; guessed if it is not calibrated.
    """

    tags: Sequence[tuple[int, np.ndarray]]
    board: BoardPose | None
    message: str
    wires: Sequence[LineSighting]
    mount: CameraMount

    def figures(self) -> dict[str, Any]:
        """Return a mapping for JSON: lengths in m, attitudes as quaternions xyzw, pixels in OpenCV's convention."""
        pixels = [np.round(self.mount.camera.project(wire.rays_C)[0], 2).tolist() for wire in self.wires]
        out: dict[str, Any] = {
            "tags": [{"id": number, "corners": np.round(corners, 3).tolist()} for number, corners in self.tags], "message": self.message,
            "wires": [{"pixels": arc, "length_px": round(wire.length, 1)} for arc, wire in zip(pixels, self.wires)]}
        if (b := self.board) is not None:
            out["board"] = {"position": b.p_CS.tolist(), "orientation": so3.quat_from_matrix(b.R_CS).tolist(),
                            "sigma": np.sqrt(np.diag(b.covariance)).tolist(), "rms_px": b.rms, "ids": list(b.ids)}
        return out


def guessed_mount(name: str, width: int, height: int) -> CameraMount:
    """Return a guessed camera without distortion, similar to a webcam."""
    focal = GUESSED_FOCAL * width
    return CameraMount(name, PinholeCamera(width, height, focal, focal, 0.5 * (width - 1), 0.5 * (height - 1)), np.zeros(3), np.eye(3))


def detect(image: CameraImage, mount: CameraMount, board: TagBoard, wires: LineDetectionConfig, calibrated: bool,
           max_range: float = 6.0) -> ImageDetections:
    """Detect tags, board and wires in one image.

    Args:
        image: of the camera's size.
        mount: the camera.
        board: whose pose is estimated.
        wires: settings of the detection of wires.
        calibrated: whether the camera is calibrated; otherwise no pose is estimated.
        max_range: a board further away is taken for one of another size [m].

    Raises:
        ImageError: it is not of the camera's size or has no pixels.
    """
    grey = mono_image(image, mount.camera)
    tags = find_tags(grey, mount.camera, board)
    found = Localization(None, message="the camera is not calibrated: no pose")
    if calibrated:
        found = BoardLocalizer(board, mount, max_range).process(grey, 0.0)
    pixels = rgb_image(image, mount.camera) if wires.appearance == "red" else grey
    return ImageDetections(tags, found.board, found.message, detect_lines(pixels, mount.camera, wires), mount)


def find_tags(grey: np.ndarray, camera: Camera, board: TagBoard) -> list[tuple[int, np.ndarray]]:
    """Return number and corners (TL, TR, BR, BL) [px], (4, 2), of tags of a board's family in a grey image, repeated ones too."""
    side = 0.1 * min(board.pad_size)
    anything = replace(board, grid=None, tags=tuple(Tag(number, (0.0, 0.0), side) for number in range(FAMILIES[board.family][1])))
    detection = TagDetector(anything, camera).search(grey)
    pixels = camera.project(refine_corners(grey, camera, detection.corners, modules=board.modules).rays_C)[0]
    return list(zip(detection.ids, pixels))


def draw_detections(image: CameraImage, detections: ImageDetections, board: TagBoard, name: str) -> GalleryImage:
    """Return the image with its detections drawn."""
    picture = canvas(mono_image(image, detections.mount.camera))
    draw_wires(picture, detections.mount.camera, detections.wires)
    for number, corners in detections.tags:
        _line(picture, corners, TAG, closed=True)
        cv2.circle(picture, _rounded(corners[0]), 3, TAG, -1)
        _text(picture, str(number), _rounded(corners.mean(axis=0)), TAG)
    text = f"{name}: {len(detections.tags)} tags, {len(detections.wires)} wires"
    if detections.board is not None:
        pose = TargetPose(image.stamp, detections.board.p_CS, so3.quat_from_matrix(detections.board.R_CS), detections.board.covariance)
        draw_board(picture, detections.mount.camera, board, pose, detections.board.ids)
        text += f", board at {np.linalg.norm(detections.board.p_CS):.2f} m"
    return caption(picture, text)


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


def draw_wires(image: np.ndarray, camera: Camera, wires: Sequence[LineSighting]) -> None:
    """Draw detected wires."""
    for wire in wires:
        _line(image, camera.project(wire.rays_C)[0], WIRE)


def caption(pixels: np.ndarray, text: str) -> GalleryImage:
    """Write a line of text onto an image and return both."""
    _text(pixels, text[:80], (8, 18), TEXT)
    return text, pixels


def _text(image: np.ndarray, text: str, place: tuple[int, int], colour: tuple[int, int, int]) -> None:
    for ink, width in (((0, 0, 0), 3), (colour, 1)):
        cv2.putText(image, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.5, ink, width, cv2.LINE_AA)


def _rounded(pixel: np.ndarray) -> tuple[int, int]:
    return tuple(np.rint(pixel).astype(int).tolist())


def _line(image: np.ndarray, pixels: np.ndarray, colour: tuple[int, int, int], closed: bool = False) -> None:
    if len(pixels) and np.isfinite(pixels).all() and np.abs(pixels).max() < 1e5:
        cv2.polylines(image, [np.rint(16 * pixels).astype(np.int32)], closed, colour, 1, cv2.LINE_AA, 4)


class Gallery:
    """Keeps every n-th picture that is offered; when it is full, every other one is dropped and n is doubled.

    Attributes:
        images: the pictures, in their order, each with the stamp of its image in its text.
    """
    def __init__(self, capacity: int = 12) -> None:
        self.images: list[GalleryImage] = []
        self._capacity, self._step, self._offered = capacity, 1, 0

    def due(self, within: int = 1) -> bool:
        """Return whether one of the next `within` pictures will be kept."""
        return -self._offered % self._step < within

    def offer(self, stamp: int, draw: Callable[[], GalleryImage | None]) -> None:
        """Draw and keep the picture of the next image, of a stamp [ns], if it is due and available."""
        picture = draw() if self.due() else None
        self._offered += 1
        if picture is None:
            return
        self.images.append((f"{1e-9 * stamp:.3f} s: {picture[0]}", picture[1]))
        if len(self.images) >= self._capacity:
            self.images, self._step = self.images[::2], 2 * self._step
