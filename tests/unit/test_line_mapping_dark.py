"""Wires without a colour: dark ridges on textured walls, mapped as well as red wires are."""

import numpy as np
import pytest
from perch_core import so3
from perch_core.camera import PinholeCamera
from perch_core.catenary import Catenary
from perch_core.vehicle import load_vehicle
from perch_perception.line_mapping import LineDetectionConfig, LineMapper, MapperConfig, detect_lines, place
from perch_perception.line_mapping.ridge import dark_ridges
from perch_perception.pose_buffer import BodyState
from perch_sim.rendering import CableCurve, Renderer, Scene

MOUNT = load_vehicle("rpg").mounts["front"]
DARK = LineDetectionConfig(appearance="dark")
GREY = (88.0, 88.0, 92.0)  # what grey cables have in the simulator; the walls are at 115 +- 25 %


def scene(cables, radius=0.03, contrast=0.25):
    return Scene(np.array([-3.0, -4.5, 0.0]), np.array([9.0, 4.5, 6.0]), contrast=contrast, seed=1,
                 cables=tuple(CableCurve(cable.sample(60), radius, GREY) for cable in cables))


@pytest.mark.parametrize("angle_deg", [0.0, 37.0, 90.0, 151.0])
def test_answers_to_a_dark_line_in_any_direction_with_about_its_depth(angle_deg):
    """An ideal line of depth 40: the same answer in every direction, none from a step edge of the same height."""
    u, v = np.meshgrid(np.arange(320.0), np.arange(240.0))
    across = (v - 120) * np.cos(np.radians(angle_deg)) - (u - 160) * np.sin(np.radians(angle_deg))
    line = np.where(np.abs(across) < 3.0, 100, 140).astype(np.uint8)
    edge = np.where(across < 0.0, 100, 140).astype(np.uint8)
    middle = dark_ridges(line)[100:140, 140:180][np.abs(across[100:140, 140:180]) < 1].mean()
    assert 12.0 < middle < 25.0
    away = np.abs(across) < 1
    assert dark_ridges(edge)[100:140, 140:180][away[100:140, 140:180]].max() < 0.35 * middle
    bright = (240 - line).astype(np.uint8)
    assert dark_ridges(bright)[100:140, 140:180][away[100:140, 140:180]].max() < 0.5 * middle


def test_maps_grey_wires_within_three_centimetres():
    cables = [Catenary.from_sag(np.array([3.0, -4.0, 2.6]), np.array([3.0, 4.0, 2.8]), 0.1),
              Catenary.from_sag(np.array([3.6, -4.0, 2.1]), np.array([3.2, 4.0, 2.0]), 0.1)]
    renderer, rng = Renderer(scene(cables), MOUNT, seed=1), np.random.default_rng(0)
    mapper = LineMapper(MapperConfig())
    for k, share in enumerate(np.linspace(0.0, 1.0, 14)):
        p, R = np.array([0.0, 0.0, 1.8 + 0.8 * share]), so3.exp(np.array([0.02, -0.2 + 0.05 * np.sin(7 * share), 0.0]))
        body = BodyState(0.1 * k, p, so3.quat_from_matrix(R @ so3.exp(5e-4 * rng.standard_normal(3))), np.zeros(3),
                         np.zeros(3), np.diag([2.5e-5] * 3 + [1e-5] * 3))
        seen = detect_lines(renderer.render([(p, R)], rng), MOUNT.camera, DARK)
        result = mapper.update(0.1 * k, body, [place(one, body, MOUNT) for one in seen])
    assert len({line.segment.id % 100 for line in result.lines}) == 2
    for cable in cables:
        points = cable.sample(200)
        points = points[np.abs(points[:, 1]) < 1.5]
        assert np.mean(np.min([line.segment.distance(points) for line in result.lines], axis=0)) < 0.03
    assert all(line.segment.radius == 0.03 for line in result.lines), "the width of a dark wire is not measured"


def test_texture_alone_is_no_wire():
    renderer = Renderer(scene([], contrast=0.25), MOUNT, seed=1)
    for k in range(2):
        pose = np.array([0.0, 0.3 * k, 2.0]), so3.exp(np.array([0.0, 0.1, 0.4 * k]))
        assert detect_lines(renderer.render([pose], np.random.default_rng(k)), MOUNT.camera, DARK) == []


def test_takes_grey_images_too():
    camera = PinholeCamera(640, 480, 385.0, 385.0, 320.0, 240.0)
    image = np.full((480, 640), 130, np.uint8)
    image[200:206] = 80
    (one,) = detect_lines(image, camera, DARK)
    np.testing.assert_allclose(camera.project(one.rays_C)[0][:, 1], 202.5, atol=0.5)
