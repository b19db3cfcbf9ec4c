"""The first landmarks of a take-off: points of the ground under a standing vehicle, and features that stay spread as it rises."""

import cv2
import numpy as np
import pytest
from perch_core import so3
from perch_core.vehicle import load_vehicle
from perch_perception.vio import VioConfig, ground, start
from perch_perception.vio import state as at
from perch_perception.vio.bearing import observe
from perch_perception.vio.msckf import Msckf
from perch_perception.vio.tracker import Tracker

MOUNT = load_vehicle("rpg").mounts["down"]
CONFIG = VioConfig()
FLOOR, STANDING = 0.4, 0.15


def standing(rng, height=STANDING):
    """A filter whose state is off by what its covariance says, and 80 features of the ground as the camera sees them."""
    p_WB = np.array([1.0, -2.0, FLOOR + height])
    points = np.column_stack([p_WB[:2] + rng.uniform(-0.35, 0.35, (80, 2)), FLOOR + rng.normal(0, ground.SIGMA, 80)])
    known = start.configured_pose(p_WB, 0.3)
    R_WB = so3.exp(np.array([0.0, 0.0, 0.3]))
    state = start.initial_state(CONFIG, MOUNT, 0, R_WB, known, np.zeros(3), np.zeros(3), 0.01, 0.005, 0.001)
    X_C = ((points - p_WB) @ R_WB - MOUNT.p_BC) @ MOUNT.R_BC
    pixels, valid = MOUNT.camera.project(X_C)
    valid &= MOUNT.camera.contains(pixels, 8)
    filter = Msckf(CONFIG, state, MOUNT.camera.fx)
    noise = rng.normal(0, CONFIG.calibration.track, pixels.shape)
    wrong = rng.multivariate_normal(np.zeros(at.CORE_SIZE), state.P)
    wrong[at.LENS] = 0.0
    state.inject(wrong)
    return filter, points, np.flatnonzero(valid), observe(MOUNT.camera, (pixels + noise)[valid])


@pytest.mark.slow
def test_points_of_the_ground_are_where_their_covariance_says():
    rng, squared = np.random.default_rng(1), []
    for _ in range(40):
        filter, points, ids, bearings = standing(rng)
        count = ground.add_ground_landmarks(filter, ids, bearings, FLOOR)
        s = filter.state
        assert 10 <= count <= CONFIG.filter.landmarks and s.size == at.CORE_SIZE + 3 * count
        assert np.linalg.eigvalsh(s.P)[0] > -1e-12
        for k, (number, landmark) in enumerate(s.landmarks.items()):
            rows = slice(s.landmark_start + 3 * k, s.landmark_start + 3 * k + 3)
            error = landmark.X_W - points[number]
            squared.append(error @ np.linalg.solve(s.P[rows, rows], error) / 3.0)
    # one, if errors and covariances agree; the focal length and what is not linear at this distance leave a margin
    assert 0.6 < np.mean(squared) < 1.6


@pytest.mark.parametrize("height", [0.02, 0.09])
def test_a_camera_close_to_the_ground_takes_in_nothing(height):
    filter, _, ids, bearings = standing(np.random.default_rng(2), height)
    assert ground.add_ground_landmarks(filter, ids, bearings, FLOOR) == 0
    assert not filter.state.landmarks and filter.state.size == at.CORE_SIZE


def features_after_rising():
    """Features of a floor that shrinks to a third, as at a take-off."""
    rng = np.random.default_rng(3)
    floor = cv2.GaussianBlur(rng.uniform(0, 255, (1440, 1920)).astype(np.float32), (0, 0), 3.0)
    floor = cv2.normalize(floor, None, 0, 255, cv2.NORM_MINMAX)
    tracker = Tracker(CONFIG.tracker, MOUNT.camera)
    for scale in np.geomspace(1.0, 1.0 / 3.0, 40):
        A = np.array([[scale, 0, 320 - 960 * scale], [0, scale, 240 - 720 * scale]])
        image = cv2.warpAffine(floor, A, (640, 480), flags=cv2.INTER_AREA).astype(np.uint8)
        seen = tracker.track(image, np.eye(3))
    between = np.linalg.norm(seen.pixels[:, None] - seen.pixels[None], axis=2) + 1e9 * np.eye(len(seen.ids))
    return seen, between.min()


@pytest.mark.parametrize("grid", [0.0, 3.6])  # on a grid of 3.6 px, many lie at the limit of 10.8 px
def test_of_features_that_are_close_the_older_one_stays(grid):
    pixels = np.random.default_rng(1).uniform(0, 200, (150, 2))
    pixels = (np.round(pixels / grid) * grid if grid else pixels).astype(np.float32)
    kept = []
    for k in range(len(pixels)):
        if all(np.linalg.norm(pixels[k] - pixels[other]) >= np.float32(10.8) for other in kept):
            kept.append(k)
    tracker = Tracker(CONFIG.tracker, MOUNT.camera)
    tracker._pixels, tracker._ids = pixels, np.arange(len(pixels))
    tracker._thin()
    assert tracker._ids.tolist() == kept and 20 < len(kept) < 140


@pytest.mark.slow
def test_features_that_draw_together_make_room_for_others(monkeypatch):
    spread, apart = features_after_rising()
    monkeypatch.setattr(Tracker, "_thin", lambda self: None)
    crowded, near = features_after_rising()
    assert near < 10.8 <= apart  # 0.6 of the spacing of new ones
    assert len(spread.ids) >= 0.85 * CONFIG.tracker.features - 10
    assert spread.pixels.std(axis=0).min() > 1.2 * crowded.pixels.std(axis=0).min()
    assert np.all(np.diff(spread.ids) > 0), "older features first"
