"""Tags as other cameras see them: images warped from a print, with blur, gamma, sharpening and noise that the renderer does not have."""

import cv2
import numpy as np
import pytest
from perch_core import so3
from perch_core.camera import PinholeCamera
from perch_core.camera_mount import CameraMount
from perch_core.tag_board import Tag, TagBoard, TagGrid
from perch_perception.tags import BoardLocalizer, TagDetector, refine_corners
from perch_perception.tags.view import VirtualView

CAMERA = PinholeCamera(640, 480, 480.0, 480.0, 319.5, 239.5)
MOUNT = CameraMount("front", CAMERA, np.zeros(3), np.eye(3))
FACING = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])  # R_CS of a board square to the camera, s1 up
RESOLUTION = 1500.0  # of the print [px/m]
OVER = 3             # samples of the scene per pixel and direction


def printed(board):
    """The board seen from outside, s1 up, with black squares between the corners of a grid's tags; and pixels of its corners (n, 4, 2)."""
    extent = np.array(board.pad_size)
    image = np.full(np.rint(extent * RESOLUTION).astype(int), 230, np.uint8)
    pixels = (extent[::-1] / 2 - board.corners_S[..., [1, 0]]) * RESOLUTION - 0.5
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_APRILTAG_{board.family}"))
    for tag, corners in zip(board.tags, pixels):
        if board.corner_squares:
            gap = board.grid.spacing * tag.size * RESOLUTION
            for corner in corners:
                far = corner + gap * np.sign(corner - corners.mean(axis=0))
                low, high = np.minimum(corner, far) + 0.5, np.maximum(corner, far) + 0.5
                image[round(low[1]):round(high[1]), round(low[0]):round(high[0])] = 20
        marker = cv2.aruco.generateImageMarker(dictionary, tag.id, board.modules, borderBits=board.border)
        square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32) * board.modules - np.float32(0.5)
        warp = cv2.getPerspectiveTransform(square, corners.astype(np.float32))
        grey = np.where(marker > 127, 230, 20).astype(np.uint8)
        mask = cv2.warpPerspective(np.full_like(grey, 255), warp, image.shape[::-1], flags=cv2.INTER_NEAREST)
        cv2.copyTo(cv2.warpPerspective(grey, warp, image.shape[::-1], flags=cv2.INTER_NEAREST), mask, image)
    return image


def photographed(boards, rng, blur=0.6, gamma=1.0, sharpen=0.0, noise=1.5):
    """An image of boards [(board, p_CS, R_CS)] before a wall; the camera blurs by `blur` px, bends grey values and sharpens."""
    scene = cv2.resize(rng.uniform(60, 180, (30, 40)).astype(np.uint8), (640 * OVER, 480 * OVER), interpolation=cv2.INTER_CUBIC)
    for board, p_CS, R_CS in boards:
        image, (s1, s2) = printed(board), np.array(board.pad_size) / 2
        corners = CAMERA.project(np.array([[s1, s2, 0], [s1, -s2, 0], [-s1, -s2, 0], [-s1, s2, 0]]) @ R_CS.T + p_CS)[0]
        h, w = image.shape
        source = np.array([[0, 0], [w, 0], [w, h], [0, h]], np.float32) - np.float32(0.5)
        warp = cv2.getPerspectiveTransform(source, ((corners + 0.5) * OVER - 0.5).astype(np.float32))
        mask = cv2.warpPerspective(np.full_like(image, 255), warp, scene.shape[::-1])
        cv2.copyTo(cv2.warpPerspective(image, warp, scene.shape[::-1]), mask, scene)
    light = cv2.resize(scene.astype(np.float32), (640, 480), interpolation=cv2.INTER_AREA)
    light = cv2.GaussianBlur(light, (0, 0), np.sqrt(max(blur**2 - 0.08, 1e-4)))
    grey = 255.0 * (light / 255.0) ** gamma
    if sharpen:
        grey = grey + sharpen * (grey - cv2.GaussianBlur(grey, (0, 0), 1.0))
    return np.clip(np.rint(grey + rng.normal(0, noise, grey.shape)), 0, 255).astype(np.uint8)


def pad(ids=(0, 1, 2, 3), family="36h11", size=0.16, border=1):
    centres = ((0.2, 0.2), (0.2, -0.2), (-0.2, -0.2), (-0.2, 0.2))
    return TagBoard((0.6, 0.6), tuple(Tag(i, c, size) for i, c in zip(ids, centres)), family, border)


def turned(*degrees):
    return so3.exp(np.radians(degrees)) @ FACING


def errors(pose, p_CS, R_CS):
    """Position [m] and attitude [rad] of a `BoardPose`."""
    return np.linalg.norm(p_CS - pose.p_CS), np.linalg.norm(so3.log(R_CS @ pose.R_CS.T))


@pytest.mark.parametrize(("blur", "gamma", "sharpen"), [(0.45, 1.0, 0.0), (0.6, 0.6, 0.5), (1.0, 1.0, 1.0), (1.6, 0.8, 0.0)])
def test_another_blur_gamma_and_sharpening_do_not_bias_the_corners(blur, gamma, sharpen):
    """Corners within 0.35 px, and all measured; the pose within 1 cm and 0.5 deg at 1.6 m, not surer than it is."""
    rng, board = np.random.default_rng(1), pad()
    p, R = np.array([0.1, -0.05, 1.6]), turned(25.0, -20.0, 10.0)
    truth = CAMERA.project(board.corners_S @ R.T + p)[0]
    image = photographed([(board, p, R)], rng, blur, gamma, sharpen)
    refined = refine_corners(image, CAMERA, truth + rng.normal(0, 0.7, truth.shape))
    off = CAMERA.project(refined.rays_C)[0] - truth
    assert refined.measured.all() and np.abs(off).max() < 0.35
    pose = BoardLocalizer(board, MOUNT).process(image, 0.0).board
    position, attitude = errors(pose, p, R)
    assert pose.ids == board.ids and position < 0.01 and np.degrees(attitude) < 0.5
    by_lens = pose.by_intrinsics * (0.003, 0.003, 0.5, 0.5)
    error = np.concatenate([p - pose.p_CS, so3.log(R @ pose.R_CS.T)])
    assert error @ np.linalg.solve(pose.covariance + by_lens @ by_lens.T, error) < 22.5  # 99.9 % of chi^2 with 6 degrees of freedom


@pytest.mark.parametrize(("family", "ids", "border"), [
    ("16h5", (3, 7, 11, 29), 1), ("25h9", (0, 9, 20, 34), 1), ("36h10", (5, 700, 1500, 2319), 1),
    ("36h11", (586, 300, 17, 42), 1), ("36h11", (586, 300, 17, 42), 2)])
def test_every_family_and_any_numbers_are_found(family, ids, border):
    rng, board = np.random.default_rng(2), pad(ids, family, border=border)
    p, R = np.array([-0.1, 0.1, 1.4]), turned(-15.0, 30.0, 200.0)
    pose = BoardLocalizer(board, MOUNT).process(photographed([(board, p, R)], rng), 0.0).board
    position, attitude = errors(pose, p, R)
    assert sorted(pose.ids) == sorted(ids) and position < 0.005 and np.degrees(attitude) < 0.4


@pytest.mark.parametrize(("distance", "least"), [(0.9, 34), (1.7, 9)])
def test_a_grid_whose_tags_touch_black_squares(distance, least):
    """Kalibr's AprilGrid, 6 x 6 tags of 88 mm: nearly all tags where they are 47 px wide, enough where they are 25 px.

    The print rounds tags to its own pixels, 0.3 mm: more than the corners' sigmas, and no reason to bend the lens.
    """
    rng = np.random.default_rng(3)
    board = TagBoard((0.75, 0.75), border=2, corner_squares=True, grid=TagGrid(6, 6, 0.088, 0.3, rotation=180.0))
    p, R = np.array([0.02, 0.03, distance]), turned(20.0, -12.0, 5.0)
    result = BoardLocalizer(board, MOUNT).process(photographed([(board, p, R)], rng), 0.0)
    position, attitude = errors(result.board, p, R)
    assert len(result.board.ids) >= least and position < 0.003 and np.degrees(attitude) < 0.3


@pytest.mark.parametrize(("distance", "least"), [(0.6, 10), (0.9, 30)])
def test_a_grid_that_is_tracked_keeps_its_small_tags(distance, least):
    board = TagBoard((0.75, 0.75), border=2, corner_squares=True, grid=TagGrid(6, 6, 0.088, 0.3, rotation=180.0))
    p, R = np.array([0.02, 0.03, distance]), turned(20.0, -12.0, 0.0)
    image, localizer = photographed([(board, p, R)], np.random.default_rng(3)), BoardLocalizer(board, MOUNT)
    localizer.process(image, 0.0)
    tracked = localizer.process(image, 0.05).board
    position, attitude = errors(tracked, p, R)
    assert len(tracked.ids) >= least and position < 0.003 and np.degrees(attitude) < 0.3


def test_a_view_of_tiny_tags_on_a_large_board_has_a_bounded_size(monkeypatch):
    centres = ((0.4, 0.4), (0.4, -0.4), (-0.4, -0.4), (-0.4, 0.4))
    board = TagBoard((10.0, 10.0), (*(Tag(i, c, 0.01) for i, c in enumerate(centres)), Tag(4, (4.5, 0.0), 0.9)))
    sides, resample = [], VirtualView.resample
    monkeypatch.setattr(VirtualView, "resample", lambda view, *arguments: sides.append(view.side) or resample(view, *arguments))
    image = photographed([(pad((4, 1, 2, 3)), np.array([0.0, 0.0, 2.5]), FACING)], np.random.default_rng(3))
    BoardLocalizer(board, MOUNT).process(image, 0.0)
    assert sides == [2048]


def test_any_number_of_tags_is_refined():
    """Photographs may show more tags than a board has, and OpenCV's remap takes fewer than 2^15 rows."""
    corners = 40.0 + 60.0 * np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    image = np.full((160, 160), 220, np.uint8)
    image[40:100, 40:100] = 30
    one, many = (refine_corners(image, PinholeCamera(160, 160, 150.0, 150.0, 79.5, 79.5), np.tile(corners, (n, 1, 1))) for n in (1, 400))
    np.testing.assert_allclose(many.rays_C, np.repeat(one.rays_C, 400, axis=0), atol=1e-9)


@pytest.mark.parametrize("blur", [0.6, 1.5, 2.0, 2.5])
def test_large_tags_of_a_blurred_grid_are_not_found_at_the_inner_outline_of_their_borders(blur):
    """Tags 170 px wide whose corner squares merge with them: corners found to 3 px, and all measured to 0.5 px."""
    rng = np.random.default_rng(5)
    board = TagBoard((0.4, 0.4), border=2, corner_squares=True, grid=TagGrid(2, 2, 0.16, 0.3, rotation=180.0))
    p, R = np.array([0.0, 0.0, 0.45]), turned(4.0, -3.0, 5.0)
    image = photographed([(board, p, R)], rng, blur)
    found = TagDetector(board, CAMERA).search(image)
    truth = CAMERA.project(board.corners_S @ R.T + p)[0]
    assert found.ids == board.ids and np.abs(found.corners - truth).max() < 3.0
    refined = refine_corners(image, CAMERA, found.corners, modules=board.modules)
    assert refined.measured.all() and np.abs(CAMERA.project(refined.rays_C)[0] - truth).max() < 0.5


def test_of_two_boards_alike_the_expected_one_is_followed_and_a_stray_tag_is_left_out(monkeypatch):
    monkeypatch.setattr("perch_perception.tags.localizer.MAX_TRACKED_IMAGES", 0)
    rng, board, alone = np.random.default_rng(4), pad(), TagBoard((0.2, 0.2), (Tag(2, (0.0, 0.0), 0.16),))
    here, there, R = np.array([-0.55, 0.0, 2.0]), np.array([0.5, 0.1, 2.0]), turned(10.0, 15.0, 0.0)
    localizer = BoardLocalizer(board, MOUNT)
    assert errors(localizer.process(photographed([(board, here, R)], rng), 0.0).board, here, R)[0] < 0.01
    both = localizer.process(photographed([(board, here, R), (board, there, R)], rng), 0.05)
    assert errors(both.board, here, R)[0] < 0.01
    stray = BoardLocalizer(board, MOUNT).process(photographed([(board, here, R), (alone, there, R)], rng), 0.0)
    assert "tag 2 is seen 2 times" in stray.message
    assert stray.board.ids == (0, 1, 2, 3) and errors(stray.board, here, R)[0] < 0.01


def test_two_tags_alike_and_nothing_else_are_reported():
    rng, board = np.random.default_rng(5), TagBoard((0.2, 0.2), (Tag(2, (0.0, 0.0), 0.16),))
    image = photographed([(board, np.array([-0.3, 0.0, 1.2]), FACING), (board, np.array([0.3, 0.0, 1.2]), FACING)], rng)
    assert len(TagDetector(board, CAMERA).search(image).ids) == 2
    result = BoardLocalizer(board, MOUNT).process(image, 0.0)
    assert result.board is None and "tag 2 is seen 2 times" in result.message


def test_a_tag_that_cannot_be_measured_keeps_the_detectors_corners_and_their_sigma():
    """One edge of a tag lies under tape as dark as it is: two corners keep their places, the other tags are not harmed."""
    rng, board = np.random.default_rng(6), pad()
    p, R = np.array([0.0, 0.0, 1.5]), turned(5.0, 10.0, 0.0)
    truth = CAMERA.project(board.corners_S @ R.T + p)[0]
    image = photographed([(board, p, R)], rng)
    low, high = truth[0, :2].min(axis=0) - (3, 12), truth[0, :2].max(axis=0) + (3, 2)
    u0, v0, u1, v1 = *np.round(low).astype(int), *np.round(high).astype(int)
    image[v0:v1, u0:u1] = 20
    guess = truth + rng.normal(0, 0.5, truth.shape)
    refined = refine_corners(image, CAMERA, guess)
    assert not refined.measured[0, :2].any() and refined.measured[1:].all()
    np.testing.assert_allclose(CAMERA.project(refined.rays_C)[0][~refined.measured], guess[~refined.measured], atol=1e-6)
    assert np.all(refined.sigma[~refined.measured] == 1.0) and refined.sigma[1:].max() < 0.2
