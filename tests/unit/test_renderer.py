"""Rendered images against a ray caster, the tag detector and the camera model."""

from __future__ import annotations

import dataclasses
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from oracles.ray_caster import cast
from perch_core.camera import EquidistantCamera
from perch_core.camera_mount import CameraMount
from perch_core.errors import ConfigError
from perch_core.surface import PerchSurface
from perch_core.tag_board import load_board
from perch_sim.rendering import Renderer, Scene
from perch_sim.rendering.sensor import PSF_SIGMA
from unit.camera_mounts import looking_along

CAMERA = EquidistantCamera(640, 480, 275.0, 275.0, 320.0, 240.0, (0.003908, -0.009574, 0.010173, -0.003329))
FRONT = CameraMount("front", CAMERA, [0.05, 0, 0], looking_along([1, 0, 0], [0, 0, 1]))
DOWN = CameraMount("down", CAMERA, [0.02, 0, -0.02], looking_along([0, 0, -1], [1, 0, 0]))
BOARD = load_board("pad_four_tags")
PAD = 8  # number of the pad's face: after six of the room and two of the panel
DETECTOR = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11))


def make_scene(inclination: float = 90.0, distance: float = 1.7, **changes) -> Scene:
    target = PerchSurface.from_inclination([distance, 0, 1.2], np.radians(inclination), size=(1.2, 1.2))
    return Scene(**{"room_low": [-4, -2.5, 0], "room_high": [6, 2.5, 4], "target": target, "board": BOARD} | changes)


WALL = make_scene()


def level(x: float, y: float, z: float, nose_up: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    return np.array([x, y, z]), Rotation.from_euler("Y", -nose_up, degrees=True).as_matrix()


def noiseless(scene: Scene, mount: CameraMount, pose, **arguments) -> np.ndarray:
    """What falls on the sensor: no noise, vignetting or blur."""
    return Renderer(scene, mount)._light(*mount.pose(*pose), np.zeros(3), **arguments)


@pytest.mark.parametrize("mount, pose, window", [
    (FRONT, level(0, 0, 1.2), (180, 300, 260, 380)),           # 1.7 m, head on
    (DOWN, level(0.95, 0.05, 1.5, 45), (0, 220, 200, 340)),    # half way through the manoeuvre
    (DOWN, level(1.45, 0.0, 1.3, 80), (0, 120, 60, 320)),      # 25 cm from the pad, tags in the corners of the lens
    (DOWN, level(0, 0, 1.2), (0, 120, 0, 160)),                # floor, corner of the image
    (FRONT, level(-1, 1, 1.6, 20), (200, 320, 200, 400))],     # panel, walls and floor meet
    ids=["pad", "manoeuvre", "close", "floor", "edges"])
def test_images_are_those_of_a_ray_caster(mount, pose, window):
    truth, face = cast(WALL, CAMERA, *mount.pose(*pose), window)
    drawn = noiseless(WALL, mount, pose)[window[0]:window[1], window[2]:window[3]].astype(float)
    difference = cv2.GaussianBlur(drawn - truth, (5, 5), PSF_SIGMA)[3:-3, 3:-3]
    on_pad = face[3:-3, 3:-3] == PAD
    for region in (on_pad, ~on_pad):
        if region.sum() > 100:
            assert np.sqrt(np.mean(difference[region] ** 2)) <= 4.0


@pytest.mark.parametrize("inclination", [60.0, 90.0])
@pytest.mark.parametrize("distance, zoom", [(1.7, 1), (3.0, 2)])
def test_detector_finds_all_tags_where_the_camera_model_puts_them(inclination, distance, zoom):
    """Realistic images: noise, blur, low contrast. 3 m is the limit: there on frames enlarged twice, within five."""
    scene = make_scene(inclination, distance)
    pose, rng = level(0, 0, 1.2), np.random.default_rng(5)
    renderer = Renderer(scene, FRONT, seed=3)
    p_WC, R_WC = FRONT.pose(*pose)
    seen = []
    for _ in range(1 if zoom == 1 else 5):
        image = renderer.render([pose], rng)
        assert image.shape == (480, 640) and image.dtype == np.uint8
        corners, ids, _ = DETECTOR.detectMarkers(cv2.resize(image, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_CUBIC))
        seen.append(set(ids.ravel()))
        for tag_id, found in zip(ids.ravel(), corners):
            tag_W = scene.target.p_WS + BOARD.corners_S[BOARD.ids.index(tag_id)] @ scene.target.R_WS.T
            expected, _ = CAMERA.project((tag_W - p_WC) @ R_WC)
            np.testing.assert_allclose((found[0] + 0.5) / zoom - 0.5, expected, atol=2.0)  # unrefined corners
    assert set.union(*seen) == {0, 1, 2, 3}
    assert min(len(ids) for ids in seen) >= 2


def test_pad_edges_are_where_the_camera_model_puts_them_to_a_twentieth_of_a_pixel():
    """Sub-pixel registration of the image with a ray-cast one, over the whole pad."""
    pose, window = level(0, 0, 1.2), (170, 310, 250, 390)
    truth, _ = cast(WALL, CAMERA, *FRONT.pose(*pose), window)
    drawn = noiseless(WALL, FRONT, pose)[window[0]:window[1], window[2]:window[3]]
    shift, response = cv2.phaseCorrelate(truth.astype(float), drawn.astype(float))
    assert response > 0.9
    assert np.hypot(*shift) < 0.05


def test_same_seed_and_poses_give_the_same_bytes_and_noise_differs_between_frames():
    def images(seed: int) -> list[bytes]:
        renderer, rng = Renderer(make_scene(), FRONT, seed), np.random.default_rng(seed)
        return [renderer.render([level(0, 0, 1.2)], rng).tobytes() for _ in range(2)]

    first, again, other = images(1), images(1), images(2)
    assert first == again
    assert first[0] != first[1] and first[0] != other[0]


@pytest.mark.parametrize("mount, region", [
    (FRONT, (slice(150, 331), slice(201, 417))), (DOWN, (slice(0, 77), slice(3, 640))), (FRONT, (slice(479, 480), slice(0, 1)))])
def test_a_region_is_drawn_as_in_the_whole_image_and_nothing_else(mount, region):
    (p, R), renderer = level(0.4, 0.1, 1.3, 20), Renderer(WALL, mount, seed=2)
    poses = [(p + [0.004 * k, 0, 0], R @ Rotation.from_euler("Y", 0.4 * k, degrees=True).as_matrix()) for k in range(5)]
    for exposure in (poses[:1], poses):  # sharp, and blurred
        whole = renderer.render(exposure, np.random.default_rng(4))
        part = renderer.render(exposure, np.random.default_rng(4), region=region)
        np.testing.assert_array_equal(part[region], whole[region])
        part[region] = 0
        assert not part.any() and whole[region].any()


def test_threads_may_share_a_renderer():
    renderer = Renderer(WALL, DOWN)
    poses = [level(0.1 * i, 0, 1.0 + 0.1 * i, 10.0 * i) for i in range(8)]
    alone = [renderer.render([pose], np.random.default_rng(0)) for pose in poses]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(lambda pose: renderer.render([pose], np.random.default_rng(0)), poses))
    for a, b in zip(alone, together):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("mount", [FRONT, DOWN], ids=["front", "down"])
def test_every_attitude_and_place_shows_the_room_or_the_panel(mount):
    """No void: in a closed room every ray of the lens ends on something, textured and lit."""
    rng = np.random.default_rng(7)
    scene = make_scene(120.0)
    renderer = Renderer(scene, mount)
    for _ in range(8):
        p_WB, R_WB = rng.uniform([-3.5, -2, 0.3], [5.5, 2, 3.7]), Rotation.random(random_state=rng).as_matrix()
        window = (50, 74, 70, 94)
        truth, face = cast(scene, CAMERA, *mount.pose(p_WB, R_WB), window)
        drawn = renderer._light(*mount.pose(p_WB, R_WB), np.zeros(3))[50:74, 70:94].astype(float)
        assert (face >= 0).all()
        assert np.sqrt(np.mean(cv2.GaussianBlur(drawn - truth, (5, 5), 1.0) ** 2)) <= 5.0


@pytest.mark.parametrize("gap", [0.05, 0.02])
def test_down_camera_sees_the_pad_at_contact(gap):
    contact, R_WB = WALL.target.p_WS + (gap + 0.02) * WALL.target.normal, WALL.target.R_WS
    image = noiseless(WALL, DOWN, (contact, R_WB))
    assert np.mean(image[100:380, 150:490] < 90) > 0.9  # dark velcro all over the middle


def test_target_shift_moves_panel_and_pad_together():
    shift = np.array([0.1, -0.2, 0.15])
    moved = make_scene(target=PerchSurface(WALL.target.p_WS + shift, WALL.target.R_WS, WALL.target.size))
    pose = level(0, 0, 1.2)
    by_shift = Renderer(WALL, FRONT)._light(*FRONT.pose(*pose), shift).astype(int)
    by_scene = noiseless(moved, FRONT, pose).astype(int)
    assert np.abs(by_shift - by_scene).max() <= 2
    assert np.abs(by_shift - noiseless(WALL, FRONT, pose)).max() > 100


def test_camera_that_left_the_room_still_gets_an_image():
    image = Renderer(WALL, FRONT).render([level(9.0, 0, 1.2)], np.random.default_rng(0))
    assert image.shape == (480, 640)


def test_turning_blurs_along_the_motion_only():
    """A yaw of 3 deg within the exposure: the picture keeps its rows and loses its columns."""
    yaw = [(np.array([0, 0, 1.2]), Rotation.from_euler("Z", a, degrees=True).as_matrix())
           for a in np.linspace(-1.5, 1.5, 5)]
    renderer = Renderer(WALL, FRONT)
    sharp = renderer.render(yaw[2:3], np.random.default_rng(0)).astype(float)[180:300, 260:380]
    blurred = renderer.render(yaw, np.random.default_rng(0)).astype(float)[180:300, 260:380]

    def energy(image: np.ndarray, axis: int) -> float:
        return float(np.mean(np.diff(cv2.GaussianBlur(image, (3, 3), 1.0), axis=axis) ** 2))

    assert energy(blurred, 1) < 0.4 * energy(sharp, 1)
    assert energy(blurred, 0) > 0.5 * energy(sharp, 0)


def test_standing_still_is_not_blurred():
    pose = level(0, 0, 1.2)
    renderer = Renderer(WALL, FRONT)
    np.testing.assert_array_equal(renderer.render([pose] * 7, np.random.default_rng(0)),
                                  renderer.render([pose], np.random.default_rng(0)))


def test_the_blur_of_the_pad_is_that_of_its_motion_relative_to_the_camera():
    """A pad that moves with the camera is as sharp as at rest; one that passes a camera at rest is blurred as a pad at rest in passing."""
    path = np.outer(np.linspace(-0.01, 0.01, 5), [0.0, 1.0, 0.0])
    moving, resting, renderer = [level(0.7, y, 1.2) for y in path[:, 1]], [level(0.7, 0.0, 1.2)] * 5, Renderer(WALL, FRONT)

    def pad(poses, shifts) -> np.ndarray:
        return renderer.render(poses, np.random.default_rng(0), shifts)[175:305, 255:385].astype(float)

    still, passing = pad(resting, 0.0 * path), pad(moving, 0.0 * path)
    assert np.abs(still - passing).mean() > 3.0
    assert np.abs(pad(moving, path) - still).mean() < 0.2
    assert np.abs(pad(resting, -path) - passing).mean() < 0.2


def test_a_hall_of_60_m_needs_no_more_memory_than_a_room():
    def texels(scene: Scene) -> float:
        return sum(4 * face.half[0] * face.half[1] / face.texel**2 for face in scene.faces() if face.kind == "room")

    hall = make_scene(room_low=[-30, -20, 0], room_high=[30, 20, 15])
    assert texels(hall) <= 25.1e6
    assert texels(WALL) <= texels(hall)


def test_large_cameras_see_what_small_ones_see():
    """Three pixels in each direction where there was one: 43,200 cells."""
    large = EquidistantCamera(1920, 1440, 825.0, 825.0, 961.0, 721.0, CAMERA.coefficients)
    pose = level(-2.0, 0.0, 1.2)
    small, fine = noiseless(WALL, FRONT, pose), noiseless(WALL, dataclasses.replace(FRONT, camera=large), pose)
    assert fine.shape == (1440, 1920)
    difference = cv2.resize(fine, (640, 480), interpolation=cv2.INTER_AREA).astype(float) - small
    assert np.abs(cv2.GaussianBlur(difference, (5, 5), 1.0)).mean() < 2.0


def test_scenes_that_cannot_be_are_refused():
    with pytest.raises(ConfigError, match="room_high"):
        Scene([0, 0, 0], [1, 1, 0])
    with pytest.raises(ConfigError, match="contrast"):
        make_scene(contrast=1.5)
    with pytest.raises(ConfigError, match="light"):
        make_scene(light=0.0)
    with pytest.raises(ConfigError, match="board"):
        make_scene(target=None)
