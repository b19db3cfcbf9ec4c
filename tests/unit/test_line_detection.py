"""Wires in images: found once each, and nothing else."""

import numpy as np
import pytest
from oracles.wires import MOUNT, RED, cables
from perch_core import so3
from perch_core.camera import EquidistantCamera, PinholeCamera
from perch_perception.line_mapping import LineDetectionConfig, detect_lines
from perch_sim.rendering import CableCurve, Renderer, Scene


@pytest.fixture(scope="module")
def wires():
    hanging, scene = cables(0.1)
    return hanging, Renderer(scene, MOUNT, seed=1)


POSE = np.array([0.0, 0.0, 2.2]), so3.exp(np.array([0.03, -0.2, 0.05]))


def test_detects_each_wire_once_and_nothing_else(wires):
    hanging, renderer = wires
    p_WC, R_WC = MOUNT.pose(*POSE)
    sightings = detect_lines(renderer.render([POSE], np.random.default_rng(0)), MOUNT.camera, LineDetectionConfig())
    assert len(sightings) == 3
    found = set()
    for one in sightings:
        offsets = []
        for cable in hanging:
            points = (cable.sample(3000) - p_WC) @ R_WC
            rays = points / np.linalg.norm(points, axis=1, keepdims=True)
            offsets.append(max(np.linalg.norm(rays - ray, axis=1).min() for ray in one.rays_C))
        best = int(np.argmin(offsets))
        found.add(best)
        assert MOUNT.camera.fx * offsets[best] < 0.5, "half a pixel from the axis"
        assert one.length > 500
    assert found == {0, 1, 2}


def test_finds_both_wires_of_a_blob_where_they_cross_in_the_image():
    camera = PinholeCamera(640, 480, 385.0, 385.0, 320.0, 240.0)
    image = np.full((480, 640, 3), 110, np.uint8)
    u = np.arange(640)
    for k, (a, b) in enumerate(((0.3, 140.0), (-0.2, 300.0))):
        for du in (-1, 0, 1):
            image[np.clip(np.round(a * u + b + du), 0, 479).astype(int), u] = RED
    sightings = detect_lines(image, camera, LineDetectionConfig())
    slopes = []
    for one in sightings:
        ends = camera.project(one.ends_C)[0]
        slopes.append(((ends[1] - ends[0])[1] / (ends[1] - ends[0])[0], one.length))
    for slope in (0.3, -0.2):
        assert sum(length for value, length in slopes if abs(value - slope) < 0.01) > 450


def test_straight_wires_are_one_arc_under_a_fisheye():
    """The lens bends them by 50 px; as rays they are straight."""
    fisheye = EquidistantCamera(640, 480, 275.0, 275.0, 320.0, 240.0, (0.003908, -0.009574, 0.010173, -0.003329))
    points = np.stack([np.linspace(-3, 3, 4000), np.full(4000, -1.2), np.full(4000, 1.5)], axis=1)
    pixels = fisheye.project(points)[0]
    image = np.full((480, 640, 3), 110, np.uint8)
    inside = fisheye.contains(pixels, margin=2.0)
    for d in (-1, 0, 1):
        at = np.round(pixels[inside]).astype(int)
        image[at[:, 1] + d, at[:, 0]] = RED
    assert np.ptp(pixels[inside][:, 1]) > 40
    (one,) = detect_lines(image, fisheye, LineDetectionConfig())
    normal = np.array([0.0, 1.5, 1.2]) / np.linalg.norm([1.5, 1.2])
    assert np.abs(one.rays_C @ normal).max() * 275 < 0.7


def test_no_wires_no_sightings():
    _, scene = cables(0.1)
    empty = Renderer(Scene(scene.room_low, scene.room_high, contrast=0.6, seed=4), MOUNT, seed=1)
    assert detect_lines(empty.render([POSE], np.random.default_rng(0)), MOUNT.camera, LineDetectionConfig()) == []


@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (0.3, -0.4, 0.0), (0.0, 0.1, 0.7)], ids=["square", "tilted", "askew"])
def test_a_wire_is_as_wide_as_its_radius_and_distance_say(turn):
    """Within 1.5 % in the mean, whatever its shading and the blur, from 4 m to 60 cm: a bias that grows with the distance would move every map."""
    wire = CableCurve(np.linspace([5.5, -6.0, 0.0], [5.5, 6.0, 0.0], 60), 0.03, RED)
    renderer = Renderer(Scene(np.array([-3.0, -7.0, -3.0]), np.array([9.0, 7.0, 3.0]), contrast=0.25, seed=1, cables=(wire,)), MOUNT, seed=1)
    for distance in (4.0, 2.2, 0.6):
        found = []
        for pitch in np.linspace(0.0, 0.012, 5):  # the wire lies otherwise among the pixels each time
            pose = np.array([5.5 - distance, 0.3, 0.0]), so3.exp(np.array(turn) + [0.0, pitch, 0.0])
            one = detect_lines(renderer.render([pose], np.random.default_rng(0)), MOUNT.camera, LineDetectionConfig())[0]
            away = np.linalg.norm((MOUNT.pose(*pose)[0] - [5.5, 0.0, 0.0])[[0, 2]])
            found.append(away * np.sin(0.5 * one.width))
        assert found == pytest.approx([0.03] * 5, rel=0.03), distance
        assert np.mean(found) == pytest.approx(0.03, rel=0.015), distance
