"""Tag boards: an image painted from `corners_S` is what OpenCV's detector finds, corner by corner."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from perch_core import config
from perch_core.errors import ConfigError
from perch_core.tag_board import FAMILIES, Tag, TagBoard, TagGrid, load_board

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
    ("pad_size: [0.6, 0.6]\nfamily: 25h9\ntags: [{id: 35, centre: [0, 0], size: 0.1}]", "35 is outside .* 25h9"),
    ("pad_size: [0.6, 0.6]\nfamily: 41h12\ntags: [{id: 0, centre: [0, 0], size: 0.1}]", "41h12"),
    ("pad_size: [0.6, 0.6]\ngrid: {columns: 6, rows: 6, size: 0.088}", "beyond the pad"),
    ("pad_size: [0.9, 0.9]\ngrid: {columns: 30, rows: 30, size: 0.01}", "899 is outside"),
    ("pad_size: [0.9, 0.9]\ngrid: {columns: 11, rows: 10, size: 0.05}", "grid: 110 tags are more than 100"),
    ("pad_size: [0.6, 0.6]\ntags: [{id: 1, centre: [0, 0], size: 0.1}]\ngrid: {columns: 1, rows: 1, size: 0.1}", "not both"),
    ("pad_size: [0.6, 0.6]\ncolour: red\ntags: [{id: 0, centre: [0, 0], size: 0.1}]", "colour")])
def test_impossible_boards_are_refused(tmp_path, text, message):
    path = tmp_path / "board.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=message) as caught:
        load_board(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("family", FAMILIES)
def test_families_have_the_modules_and_numbers_that_opencv_gives_them(family):
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_APRILTAG_{family}"))
    assert FAMILIES[family] == (dictionary.markerSize, len(dictionary.bytesList))


def test_a_grid_counts_along_its_rows_from_the_lower_left():
    """Kalibr's AprilGrid of 6 x 6 tags of 88 mm with gaps of 30 %: seen from outside, left is +s2 and up +s1."""
    board = TagBoard((0.8, 0.8), border=2, corner_squares=True, grid=TagGrid(6, 6, 0.088, 0.3, first_id=100))
    centres = dict(zip(board.ids, board.corners_S.mean(axis=1)))
    assert board.ids == tuple(range(100, 136)) and board.modules == 10
    np.testing.assert_allclose(centres[101] - centres[100], [0.0, -0.1144, 0.0], atol=1e-12)
    np.testing.assert_allclose(centres[106] - centres[100], [0.1144, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(centres[100] + centres[135], 0.0, atol=1e-12)


def test_unknown_board_lists_those_there_are():
    with pytest.raises(ConfigError, match="pad_four_tags"):
        config.find("boards", "no_such_board")
