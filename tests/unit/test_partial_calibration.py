"""A lens whose calibration covers less than the image, as the polynomial of a wide lens often does; and one known exactly."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest

from perch_core.camera import RadialTangentialCamera
from perch_core.camera_mount import CameraMount
from perch_core.tag_board import load_board
from perch_perception.line_mapping.detection import _width
from perch_perception.line_mapping.observation import LineObservation
from perch_perception.line_mapping.triangulation import TriangulationConfig, triangulate
from perch_perception.tags import BoardLocalizer
from perch_perception.vio.config import TrackerConfig
from perch_perception.vio.tracker import Tracker

FOLDING = RadialTangentialCamera(640, 480, 325.0, 325.0, 320.0, 240.0, coefficients=(-0.32514545, 0.15132157, 0.0, 0.0, -0.04058215))
"""Its polynomial folds at 53 deg, and a fifth of the image is beyond."""


def without_a_ray() -> np.ndarray:
    """Pixels that the calibration does not cover, shape (480, 640)."""
    u, v = np.meshgrid(np.arange(640.0), np.arange(480.0))
    return np.isnan(FOLDING.unproject(np.stack([u, v], axis=-1))).any(axis=-1)


def test_features_stay_where_the_lens_has_rays():
    beyond = without_a_ray()
    assert 0.1 < beyond.mean() < 0.3
    near = cv2.dilate(beyond.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0  # a feature moves by 1.5 px after the mask was looked at
    view = Tracker(TrackerConfig(), FOLDING)._view > 0
    assert not (view & near).any() and view.mean() > 0.6


def test_a_tag_in_the_corner_is_rejected_by_name():
    image = np.full((480, 640), 200, np.uint8)
    image[10:74, 570:634] = cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11), 1, 64)
    found = BoardLocalizer(load_board("pad_four_tags"), CameraMount("front", FOLDING, np.zeros(3), np.eye(3))).process(
        cv2.GaussianBlur(image, (0, 0), 0.6), 0.0)
    assert found.board is None and "tag 1 reaches beyond what the lens's calibration covers" in found.message


def test_a_wire_whose_edge_has_no_ray_has_no_width():
    edges = np.stack([np.linspace([320.0, 236.0], [639.0, 0.0], 9), np.linspace([320.0, 244.0], [639.0, 8.0], 9)], axis=1)
    assert without_a_ray()[0, 639] and _width(edges, FOLDING) == 0.0


@pytest.mark.parametrize("rotation", [0.0, 0.005])
def test_a_mount_that_is_known_exactly_triangulates(rotation):
    def seen(k: int) -> LineObservation:
        c = np.array([0.0, 0.0, 0.1 * k])
        rays = np.stack([np.linspace(-1.0, 1.0, 7), np.full(7, 3.0), np.ones(7)], axis=1) - c
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        return LineObservation(0.1 * k, c, rays, rays[[0, -1]], 1e-3, 0.0)

    found = triangulate([seen(k) for k in range(8)], dataclasses.replace(TriangulationConfig(), mount_rotation=rotation))
    np.testing.assert_allclose(found.curve.point, (0.0, 3.0, 1.0), atol=1e-6)
