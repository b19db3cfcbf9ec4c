"""Textures, ray cells, exposure and noise of the renderer."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from perch_core.camera import EquidistantCamera, PinholeCamera
from perch_core.camera_mount import CameraMount
from perch_core.surface import PerchSurface
from perch_core.tag_board import load_board
from perch_sim.rendering import Scene, textures
from perch_sim.rendering.atlas import _pack
from perch_sim.rendering.grid import build_grid, sample_weights
from perch_sim.rendering.renderer import spread
from perch_sim.rendering.sensor import BASE_GAIN, READ_NOISE, SHOT_NOISE, Sensor, control_exposure
from unit.camera_mounts import looking_along

CAMERA = EquidistantCamera(640, 480, 275.0, 275.0, 320.0, 240.0, (0.003908, -0.009574, 0.010173, -0.003329))
MOUNT = CameraMount("front", CAMERA, np.zeros(3), looking_along([1, 0, 0], [0, 0, 1]))


@pytest.mark.parametrize("camera", [CAMERA, PinholeCamera(640, 480, 615.0, 615.0, 320.0, 240.0),
                                    PinholeCamera(101, 67, 100.0, 100.0, 50.0, 33.0)], ids=["fisheye", "vga", "odd"])
def test_interpolated_rays_hit_their_pixels(camera):
    grid = build_grid(camera)
    rays = np.einsum("ncj,js->nsc", grid.corners.astype(float), sample_weights(1).astype(float))
    pixels, valid = camera.project(rays)
    assert valid.all()
    row, col = np.divmod(np.arange(grid.rows * grid.cols), grid.cols)
    v, u = np.divmod(np.arange(64), 8)
    expected = np.stack([col[:, None] * 8 + u, row[:, None] * 8 + v], axis=-1)
    inside = (expected[..., 0] < camera.width) & (expected[..., 1] < camera.height)
    error = np.linalg.norm(pixels - expected, axis=-1)[inside]
    assert error.max() < 0.06
    assert np.sqrt(np.mean(error**2)) < 0.015


@pytest.mark.parametrize("ss", [1, 2, 4])
def test_samples_are_centred_in_their_pixels(ss):
    weights = sample_weights(ss).reshape(4, 8, 8, ss * ss)
    np.testing.assert_allclose(weights.sum(axis=0), 1.0, atol=1e-6)
    x = (weights[1] + weights[3]).mean(axis=-1) * 8 - 0.5
    y = (weights[2] + weights[3]).mean(axis=-1) * 8 - 0.5
    np.testing.assert_allclose(x, np.broadcast_to(np.arange(8), (8, 8)), atol=1e-5)
    np.testing.assert_allclose(y, np.broadcast_to(np.arange(8)[:, None], (8, 8)), atol=1e-5)


@pytest.mark.parametrize("room", [(500.0, 5.0, 4.0), (5.0, 500.0, 4.0), (1000.0, 1000.0, 1000.0), (0.5, 1000.0, 0.5), (10.0, 5.0, 4.0)])
@pytest.mark.parametrize("panel", [(100.0, 100.0), (0.7, 85.0), (85.0, 0.7), (1.2, 1.2)])
def test_textures_of_any_scene_fit_the_images_that_opencv_takes(room, panel):
    """Sides below 32768 texels."""
    scene = Scene(np.zeros(3), np.array(room), PerchSurface(np.ones(3), np.eye(3), panel), load_board("pad_four_tags"))
    shapes = []
    for face in scene.faces():
        rows, cols = (max(8, round(2 * half / face.texel)) for half in (face.half[1], face.half[0]))
        levels = 1 + max(0, int(np.ceil(2 * np.log2(min(rows, cols) / 4))))
        shapes += [(max(1, round(rows * scale)), max(1, round(cols * scale))) for scale in 2.0 ** (-0.5 * np.arange(levels))]
    places, shape = _pack(shapes)
    assert max(shape) < 32768 and all(x + cols <= shape[1] and y + rows <= shape[0] for (x, y), (rows, cols) in zip(places, shapes))


@pytest.mark.parametrize("contrast", [0.15, 0.3, 0.8])
def test_texture_has_the_contrast_asked_for_and_corners_at_every_distance(contrast):
    texture = textures.blobs(np.random.default_rng(1), 800, 1000, 0.0025, contrast).astype(float)
    mean = texture.mean()
    assert np.percentile(np.abs(texture - mean), 99) == pytest.approx(contrast * mean, rel=0.1)
    for octave in range(4):
        level = cv2.resize(texture, None, fx=0.5**octave, fy=0.5**octave, interpolation=cv2.INTER_AREA)
        assert level.std() > 0.2 * contrast * mean
        corners = cv2.goodFeaturesToTrack(level.astype(np.uint8)[:100, :100], 200, 0.02, 8)
        assert len(corners) > 25


def test_pad_is_read_by_the_detector_in_its_own_texture():
    board = load_board("pad_four_tags")
    texel = 0.16 / 8 / 32
    image = cv2.resize(textures.pad(board, texel, np.random.default_rng(0)), None, fx=0.5, fy=0.5)
    corners, ids, _ = cv2.aruco.ArucoDetector(
        cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)).detectMarkers(image)
    assert sorted(ids.ravel()) == [0, 1, 2, 3]
    for tag_id, found in zip(ids.ravel(), corners):
        expected = (0.3 - board.corners_S[board.ids.index(tag_id)][:, [1, 0]]) / texel / 2
        np.testing.assert_allclose(found[0], expected, atol=2.0)


@pytest.mark.parametrize("grey", [30, 120, 200])
def test_noise_is_shot_plus_read_noise(grey):
    exposure = control_exposure(MOUNT, 1.0)
    sensor, rng = Sensor(CAMERA, exposure, 1, seed=0), np.random.default_rng(0)
    frames = np.stack([sensor.expose(np.full((480, 640), grey, np.uint8), rng)[235:245, 310:330] for _ in range(300)])
    assert frames.mean() == pytest.approx(grey, abs=1.0)
    expected = np.sqrt(READ_NOISE**2 + SHOT_NOISE * BASE_GAIN * grey + 1 / 12)
    assert frames.astype(float).std() == pytest.approx(expected, rel=0.05)


def test_vignette_darkens_the_corners():
    sensor = Sensor(CAMERA, control_exposure(MOUNT, 1.0), 1, seed=0)
    image = sensor.expose(np.full((480, 640), 150, np.uint8), np.random.default_rng(0))
    assert image[:20, :20].mean() < 0.75 * image[230:250, 310:330].mean()


@pytest.mark.parametrize("light, time, gain", [
    (1.0, 3.5e-3, 4.0), (0.5, 7.0e-3, 4.0), (0.2, 9.7e-3, 4.0 * 3.5 / (0.2 * 9.7)), (3.0, 3.5e-3 / 3, 4.0)])
def test_exposure_is_lengthened_before_the_gain_is_raised(light, time, gain):
    exposure = control_exposure(MOUNT, light)
    assert exposure.time == pytest.approx(time)
    assert exposure.gain == pytest.approx(gain)
    assert exposure.brightness == pytest.approx(1.0)


def test_darkness_beyond_the_gain_darkens_the_image():
    exposure = control_exposure(MOUNT, 0.02)
    assert exposure.time == MOUNT.exposure_max and exposure.gain == 16.0
    assert exposure.brightness == pytest.approx(16.0 / (4.0 * 3.5 / (0.02 * 9.7)))


def test_subframes_sit_in_the_middles_of_equal_shares():
    poses = [(np.array([float(i), 0.0, 0.0]), np.eye(3)) for i in range(4)]
    assert [p[0] for p, _ in spread(poses, 3)] == pytest.approx([0.5, 1.5, 2.5])
    assert [p[0] for p, _ in spread(poses, 1)] == pytest.approx([1.5])
    assert len(spread(poses[:1], 4)) == 4
