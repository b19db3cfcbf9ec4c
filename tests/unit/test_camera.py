"""Camera projections against OpenCV, finite differences and their own inverse."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from perch_core.camera import EquidistantCamera, PinholeCamera, RadialTangentialCamera, camera_of, camera_parameters
from perch_core.camera_mount import CameraMount
from perch_core.errors import ConfigError
from unit.camera_mounts import looking_along

SNAPDRAGON = EquidistantCamera(640, 480, 275.0, 275.0, 320.0, 240.0, (0.003908, -0.009574, 0.010173, -0.003329))
PINHOLE = PinholeCamera(640, 480, 615.0, 612.0, 319.0, 241.0)
PLUMB_BOB = RadialTangentialCamera(752, 480, 458.7, 457.3, 367.2, 248.4, (-0.2834, 0.0739, 0.00019, 1.76e-5, 0.0))  # EuRoC's cam0
RATIONAL = RadialTangentialCamera(1280, 720, 612.4, 612.1, 640.2, 361.0,  # a wide-angle lens as OpenCV calibrates it
                                  (0.412, -2.61, 3.1e-4, -2.4e-4, 1.55, 0.295, -2.43, 1.48))
RADTAN = pytest.mark.parametrize("camera", [PLUMB_BOB, RATIONAL], ids=["plumb_bob", "rational_polynomial"])
CAMERAS = pytest.mark.parametrize("camera", [SNAPDRAGON, PINHOLE, PLUMB_BOB, RATIONAL],
                                  ids=["equidistant", "pinhole", "plumb_bob", "rational_polynomial"])


def points_in_front(n: int, max_angle: float, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    theta, phi = rng.uniform(0, max_angle, n), rng.uniform(-np.pi, np.pi, n)
    rays = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)
    return rays * rng.uniform(0.1, 10.0, (n, 1))


def test_equidistant_projection_is_opencv_fisheye():
    points = points_in_front(500, 1.5)
    expected, _ = cv2.fisheye.projectPoints(points[:, None, :], np.zeros(3), np.zeros(3), SNAPDRAGON.K,
                                            SNAPDRAGON.distortion)
    pixels, valid = SNAPDRAGON.project(points)
    assert valid.all()
    np.testing.assert_allclose(pixels, expected[:, 0], atol=1e-8)


def test_pinhole_projection_is_opencv_project_points():
    points = points_in_front(500, 1.2)
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), PINHOLE.K, PINHOLE.distortion)
    np.testing.assert_allclose(PINHOLE.project(points)[0], expected[:, 0], atol=1e-8)


@RADTAN
def test_radial_tangential_projection_is_opencv_project_points(camera):
    points = points_in_front(2000, 0.95 * min(camera.max_angle, 1.2))
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera.K, camera.distortion)
    pixels, valid = camera.project(points)
    assert valid.mean() > 0.99
    np.testing.assert_allclose(pixels[valid], expected[valid, 0], atol=1e-8)


@pytest.mark.parametrize("coefficients", [
    (-0.35, 0.0, 0.0, 0.0, 0.0), (-0.3, 0.02, 1e-3, -2e-3, 0.0), (0.1, -0.4, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0, -0.8),
    (0.2, 0.0, 0.0, 0.0, 0.0, -0.5, 0.0, 0.0), (-0.3, 0.0, 1e-3, 1e-3, 0.0, 0.2, 0.1, 0.0)])
def test_nothing_folds_back_into_the_image(coefficients):
    """Along every direction pixels go outwards with the angle, up to the last valid point; beyond it there is none."""
    camera = RadialTangentialCamera(640, 480, 300.0, 300.0, 320.0, 240.0, coefficients)
    assert 0.2 < camera.max_angle < np.pi / 2
    theta = np.linspace(0.0, 1.56, 3000)
    for phi in np.linspace(-np.pi, np.pi, 24, endpoint=False):
        rays = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)
        pixels, valid = camera.project(rays)
        last = valid.sum()
        assert valid[:last].all() and 0 < last < len(theta)
        assert abs(theta[last] - camera.max_angle) < 0.02
        assert (np.diff(np.linalg.norm(pixels[:last] - pixels[0], axis=1)) > 0.0).all()
        assert np.isnan(camera.project_jacobian(rays[last:])).all()
        np.testing.assert_allclose(camera.unproject(pixels[:last]), rays[:last], atol=1e-10)


def test_without_distortion_both_perspective_cameras_agree():
    points = points_in_front(500, 1.4)
    flat = RadialTangentialCamera(640, 480, 615.0, 612.0, 319.0, 241.0)
    np.testing.assert_allclose(flat.project(points)[0], PINHOLE.project(points)[0], atol=1e-9)
    np.testing.assert_allclose(flat.shape_at(np.linspace(0, 1.2, 20)), PINHOLE.shape_at(np.linspace(0, 1.2, 20)), atol=1e-12)


@CAMERAS
def test_the_shape_of_the_lens_is_the_finite_difference(camera):
    theta = np.linspace(0.01, min(0.9 * camera.max_angle, 1.2), 20)

    def radius(theta):  # across the image, in the normalised plane; tangential distortion is no part of the shape
        bare = camera
        if isinstance(camera, RadialTangentialCamera):
            k = list(camera.coefficients)
            k[2] = k[3] = 0.0
            bare = RadialTangentialCamera(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, tuple(k))
        rays = np.stack([np.sin(theta), 0 * theta, np.cos(theta)], axis=-1)
        return (bare.project(rays)[0][:, 0] - bare.cx) / bare.fx

    shape = camera.shape_at(theta)
    np.testing.assert_allclose(shape[:, 0], 2e-6 / (radius(theta + 1e-6) - radius(theta - 1e-6)), rtol=1e-6)
    np.testing.assert_allclose(shape[:, 1], radius(theta) / theta, rtol=1e-7)


@CAMERAS
def test_a_camera_survives_camera_info(camera):
    assert camera_of(camera_parameters(camera)[0], camera.width, camera.height, camera.K, camera_parameters(camera)[1]) == camera


@pytest.mark.parametrize(("change", "why"), [
    ({"model": "fisheye624"}, "distortion_model"), ({"distortion": [0.1, 0.2]}, "2 coefficients"), ({"K": np.zeros((3, 3))}, "not calibrated"),
    ({"K": np.eye(3)}, "1 and 1 px for 640 x 480 px: the camera is not calibrated"),
    ({"distortion": [np.nan] * 5}, "finite"), ({"width": 0}, "0 x 480"), ({"K": np.eye(4)}, "intrinsic matrix")])
def test_a_camera_info_that_is_none_is_refused(change, why):
    good = dict(model="plumb_bob", width=640, height=480, K=PINHOLE.K, distortion=[0.1, 0.0, 0.0, 0.0, 0.0])
    assert camera_of(**good).model == "plumb_bob"
    with pytest.raises(ConfigError, match=why):
        camera_of(**{**good, **change})


@CAMERAS
def test_unproject_inverts_project(camera):
    points = points_in_front(2000, min(camera.max_angle, 1.54))
    pixels, valid = camera.project(points)
    assert valid.mean() > 0.99  # tangential distortion folds a little earlier on one side
    rays = points / np.linalg.norm(points, axis=-1, keepdims=True)
    np.testing.assert_allclose(camera.unproject(pixels[valid]), rays[valid], atol=1e-10)


@CAMERAS
@pytest.mark.slow
def test_every_pixel_of_the_image_has_a_unit_ray(camera):
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    pixels = np.stack([u, v], axis=-1)
    rays = camera.unproject(pixels)
    assert rays.shape == (camera.height, camera.width, 3)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=-1), 1.0, atol=1e-12)
    back, valid = camera.project(3.0 * rays)
    assert valid.all()
    np.testing.assert_allclose(back, pixels, atol=1e-8)


@CAMERAS
def test_jacobian_is_the_finite_difference(camera):
    points = np.vstack([points_in_front(200, min(1.4, 0.9 * camera.max_angle), seed=3), [[0.0, 0.0, 2.0]]])
    step = 1e-6
    numeric = np.stack([(camera.project(points + d)[0] - camera.project(points - d)[0]) / (2 * step)
                        for d in step * np.eye(3)], axis=-1)
    analytic = camera.project_jacobian(points)
    assert analytic.shape == (201, 2, 3)
    np.testing.assert_allclose(analytic, numeric, rtol=2e-5, atol=2e-3)


@CAMERAS
def test_points_behind_the_camera_are_never_projected(camera):
    points = points_in_front(500, 1.5, seed=2) * (1, 1, -1)
    pixels, valid = camera.project(points)
    assert not valid.any()
    assert np.isnan(pixels).all()
    assert np.isnan(camera.project_jacobian(points)).all()


def test_wide_lens_stops_before_its_polynomial_turns_over():
    lens = EquidistantCamera(640, 480, 275.0, 275.0, 320.0, 240.0, SNAPDRAGON.coefficients, angle_limit=math.pi)
    theta = np.linspace(0.0, math.pi, 100_001)
    turning = theta[np.argmax(np.diff([lens.radius(t) for t in theta]) < 0)]
    assert math.pi / 2 < lens.max_angle < turning
    beyond = np.array([[math.sin(turning + 0.05), 0.0, math.cos(turning + 0.05)]])
    assert not lens.project(beyond)[1].any()
    assert np.isnan(lens.unproject([[320.0 + 275.0 * (lens.radius(turning) + 0.01), 240.0]])).all()


def test_the_angle_is_found_up_to_a_fold_of_the_lens():
    """Newton's method alone is 11 deg wrong there."""
    lens = EquidistantCamera(640, 480, 275.0, 275.0, 320.0, 240.0, (0.1297, 0.0622, -0.0402, -0.0012))
    theta = np.linspace(0.0, lens.max_angle, 20_001)
    rays = lens.unproject(np.stack([320.0 + 275.0 * np.array([lens.radius(t) for t in theta]), np.full(len(theta), 240.0)], axis=1))
    seen = np.isfinite(rays).all(axis=1)
    assert seen[:-1].all()
    assert np.abs(np.arctan2(rays[seen, 0], rays[seen, 2]) - theta[seen])[:-200].max() < 1e-9


def test_published_lens_sees_133_degrees_across_and_over_160_along_the_diagonal():
    left, right = SNAPDRAGON.unproject([[0.0, 240.0], [639.0, 240.0]])
    corner, opposite = SNAPDRAGON.unproject([[0.0, 0.0], [639.0, 479.0]])
    assert math.degrees(math.acos(left @ right)) == pytest.approx(133.0, abs=1.5)
    assert 160.0 <= math.degrees(math.acos(corner @ opposite)) <= 167.5


def test_contains_counts_half_a_pixel_around_the_centres():
    pixels = np.array([[-0.4, 0.0], [-0.6, 0.0], [639.4, 479.4], [np.nan, 3.0], [5.0, 5.0]])
    assert PINHOLE.contains(pixels).tolist() == [True, False, True, False, True]
    assert PINHOLE.contains(pixels, margin=10.0).tolist() == [False] * 5


@given(st.floats(-3, 3), st.floats(-3, 3), st.floats(-3, 3))
def test_valid_means_within_the_lens(x, y, z):
    pixels, valid = SNAPDRAGON.project(np.array([x, y, z]))
    inside = math.atan2(math.hypot(x, y), z) <= SNAPDRAGON.max_angle and math.hypot(x, y, z) > 1e-6
    assert bool(valid) == inside or math.hypot(x, y, z) <= 1e-6
    assert np.isfinite(pixels).all() == bool(valid)


def test_leading_axes_broadcast():
    points = points_in_front(24, 1.0).reshape(2, 3, 4, 3)
    pixels, valid = SNAPDRAGON.project(points)
    assert pixels.shape == (2, 3, 4, 2) and valid.shape == (2, 3, 4)
    np.testing.assert_array_equal(pixels.reshape(-1, 2), SNAPDRAGON.project(points.reshape(-1, 3))[0])


def test_looking_along_gives_the_usual_optical_frames():
    front = looking_along([1, 0, 0], [0, 0, 1])
    np.testing.assert_allclose(front, [[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    down = looking_along([0, 0, -1], [1, 0, 0])
    np.testing.assert_allclose(down, [[0, -1, 0], [-1, 0, 0], [0, 0, -1]])


def test_mount_pose_composes_body_and_camera():
    mount = CameraMount("front", PINHOLE, [0.1, 0.0, -0.02], looking_along([1, 0, 0], [0, 0, 1]))
    R_WB = cv2.Rodrigues(np.array([0.1, -0.7, 0.4]))[0]
    p_WC, R_WC = mount.pose(np.array([1.0, 2.0, 3.0]), R_WB)
    point_C = np.array([0.3, -0.2, 2.0])
    point_B = mount.R_BC @ point_C + mount.p_BC
    np.testing.assert_allclose(R_WC @ point_C + p_WC, R_WB @ point_B + [1.0, 2.0, 3.0])


@pytest.mark.parametrize("change, key", [
    ({"rate": 0.0}, "rate"), ({"exposure": 0.02}, "exposure"), ({"R_BC": 2 * np.eye(3)}, "R_BC"),
    ({"R_BC": np.diag([1.0, 1.0, -1.0])}, "R_BC"), ({"transport_min": 0.02}, "transport_min")])
def test_impossible_mounts_are_refused(change, key):
    with pytest.raises(ConfigError, match=key):
        CameraMount(**{"name": "x", "camera": PINHOLE, "p_BC": np.zeros(3), "R_BC": np.eye(3)} | change)


def test_impossible_cameras_are_refused():
    with pytest.raises(ConfigError, match="fx"):
        PinholeCamera(640, 480, -1.0, 600.0, 320.0, 240.0)
    with pytest.raises(ConfigError, match="coefficients"):
        EquidistantCamera(640, 480, 275.0, 275.0, 320.0, 240.0, (0.1, 0.2, math.nan, 0.0))
