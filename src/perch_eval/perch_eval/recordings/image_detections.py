"""Detections in single images, without an IMU: tags, wires, and, if the camera is calibrated, the pose of the board."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from perch_core import so3
from perch_core.camera import Camera, PinholeCamera
from perch_core.camera_mount import CameraMount
from perch_core.tag_board import FAMILIES, Tag, TagBoard
from perch_core.values import CameraImage, TargetPose
from perch_eval.recordings.drawing import GalleryImage, canvas, caption, draw_board, draw_tags, draw_wires
from perch_perception.images import mono_image, rgb_image
from perch_perception.line_mapping import LineDetectionConfig, LineSighting, detect_lines
from perch_perception.tags import BoardLocalizer, BoardPose, Localization, TagDetector, refine_corners

GUESSED_FOCAL = 0.8  # of a camera without calibration, as a share of the image's width


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
    draw_tags(picture, detections.tags)
    text = f"{name}: {len(detections.tags)} tags, {len(detections.wires)} wires"
    if detections.board is not None:
        pose = TargetPose(image.stamp, detections.board.p_CS, so3.quat_from_matrix(detections.board.R_CS), detections.board.covariance)
        draw_board(picture, detections.mount.camera, board, pose, detections.board.ids)
        text += f", board at {np.linalg.norm(detections.board.p_CS):.2f} m"
    return GalleryImage(image.stamp, text, caption(picture, text[:80]))
