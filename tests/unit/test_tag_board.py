"""Tag boards: an image painted from `corners_S` is what OpenCV's detector finds, corner by corner."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from perch_core import config
from perch_core.errors import ConfigError
from perch_core.tag_board import Tag, TagBoard, load_board

PIXELS_PER_METRE = 1000.0


def seen_from_outside(board: TagBoard) -> tuple[np.ndarray, np.ndarray]:
    """A head-on picture of the board with s1 up, and the corners' pixels (n, 4, 2)."""
    extent = np.array(board.pad_size)
    pixels = ((extent[::-1] / 2 - board.corners_S[..., [1, 0]]) * PIXELS_PER_METRE).astype(np.float32)  # u: -s2, v: -s1
    image = np.full(np.rint(extent * PIXELS_PER_METRE).astype(int), 235, np.uint8)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    for tag_id, corners in zip(board.ids, pixels):
        marker = cv2.aruco.generateImageMarker(dictionary, tag_id, 400)
        side = 400.0
        square = np.array([[0, 0], [side, 0], [side, side], [0, side]], np.float32)
        warp = cv2.getPerspectiveTransform(square, corners)
        size = image.shape[::-1]
        mask = cv2.warpPerspective(np.full_like(marker, 255), warp, size, flags=cv2.INTER_NEAREST)
        image = np.where(mask > 0, cv2.warpPerspective(marker, warp, size), image)
    return image, pixels


@pytest.mark.parametrize("rotation", [0.0, 90.0, -30.0])
def test_detector_returns_the_corners_in_the_board_order(rotation):
    standard = load_board("pad_four_tags")
    board = TagBoard((0.7, 0.7), tuple(Tag(t.id, t.centre, t.size * 0.8, rotation) for t in standard.tags))
    image, pixels = seen_from_outside(board)
    found, ids, _ = cv2.aruco.ArucoDetector(
        cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)).detectMarkers(image)
    assert sorted(ids.ravel()) == [0, 1, 2, 3]
    for tag_id, corners in zip(ids.ravel(), found):
        np.testing.assert_allclose(corners[0], pixels[board.ids.index(tag_id)], atol=2.5)


def test_standard_board_is_the_papers_pad():
    board = load_board("pad_four_tags")
    assert board.pad_size == (0.6, 0.6)
    assert board.ids == (0, 1, 2, 3)
    assert board.corners_S.shape == (4, 4, 3)
    sides = np.linalg.norm(board.corners_S - np.roll(board.corners_S, 1, axis=1), axis=-1)
    np.testing.assert_allclose(sides, 0.16)
    assert np.all(board.corners_S[..., 2] == 0.0)


@pytest.mark.parametrize("text, message", [
    ("pad_size: [0.6, 0.6]\ntags: []", "at least one tag"),
    ("pad_size: [0.6, 0.6]\ntags: [{id: 0, centre: [0, 0], size: 0.16}, {id: 0, centre: [0.2, 0], size: 0.1}]",
     "not all different"),
    ("pad_size: [0.6, 0.6]\ntags: [{id: 0, centre: [0.28, 0], size: 0.16}]", "beyond the pad"),
    ("pad_size: [0.6, 0.6]\ntags: [{id: 999, centre: [0, 0], size: 0.16}]", "999"),
    ("pad_size: [0.6, 0.6]\ntags: [{id: 0, centre: [0, 0], size: -0.1}]", "size"),
    ("pad_size: [0.6, 0.6]\nfamily: 25h9\ntags: [{id: 0, centre: [0, 0], size: 0.1}]", "25h9"),
    ("pad_size: [0.6, 0.6]\ncolour: red\ntags: [{id: 0, centre: [0, 0], size: 0.1}]", "colour")])
def test_impossible_boards_are_refused(tmp_path, text, message):
    path = tmp_path / "board.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=message) as caught:
        load_board(path)
    assert str(path) in str(caught.value)


def test_unknown_board_lists_those_there_are():
    with pytest.raises(ConfigError, match="pad_four_tags"):
        config.find("boards", "no_such_board")
