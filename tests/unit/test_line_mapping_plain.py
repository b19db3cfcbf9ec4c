"""Wires without a colour of their own: ridges of either sign, straight through the image, and apart from what is behind them."""

import cv2
import numpy as np
import pytest
from perch_core import so3
from perch_core.camera import EquidistantCamera, PinholeCamera
from perch_core.catenary import Catenary
from perch_core.vehicle import load_vehicle
from perch_perception.line_mapping import BackgroundCheck, LineDetectionConfig, LineMapper, MapperConfig, detect_lines, place
from perch_perception.line_mapping.ridges import ridges
from perch_perception.pose_buffer import BodyState
from perch_sim.rendering import CableCurve, Renderer, Scene

MOUNT = load_vehicle("rpg").mounts["front"]
CAMERA = PinholeCamera(640, 480, 385.0, 385.0, 320.0, 240.0)
SMALL = PinholeCamera(320, 240, 385.0, 385.0, 160.0, 120.0)
PLAIN = LineDetectionConfig(appearance="plain")
GREY = (88.0, 88.0, 92.0)  # what grey cables have in the simulator; the walls are at 115 +- 25 %


def scene(cables, radius=0.03, contrast=0.25, wall=9.0):
    return Scene(np.array([-3.0, -4.5, 0.0]), np.array([wall, 4.5, 6.0]), contrast=contrast, seed=1,
                 cables=tuple(CableCurve(cable.sample(60), radius, GREY) for cable in cables))


def woods(rng, camera=CAMERA):
    """Leaves and branches: texture of all sizes, short ridges in all directions, grey values 20 to 200, shape (height, width)."""
    image = np.full((camera.height, camera.width), 90.0)
    for size in (1.5, 3.0, 7.0, 20.0):
        layer = cv2.GaussianBlur(rng.standard_normal(image.shape), (0, 0), size)
        image += 22.0 * layer / layer.std()
    canvas = np.clip(image, 20, 200).astype(np.uint8)
    for _ in range(150):
        start, angle = rng.uniform((0, 0), (camera.width, camera.height)), rng.uniform(0, np.pi)
        branch = np.rint(start + np.array([[0.0], [rng.uniform(10, 45)]]) * [np.cos(angle), np.sin(angle)]).astype(np.int32)
        cv2.polylines(canvas, [branch], False, int(rng.integers(20, 200)), 1, cv2.LINE_AA)
    return canvas


def strung(image, ends, grey, width, camera=CAMERA, bend=0.0):
    """The image with a wire between two pixels that sags by `bend` px in its middle."""
    t = np.linspace(-0.1, 1.1, 400)[:, None]
    points = (1 - t) * np.array(ends[0]) + t * np.array(ends[1]) + np.array([0.0, 1.0]) * 4 * bend * t * (1 - t)
    over = cv2.resize(image, None, fx=4, fy=4, interpolation=cv2.INTER_LINEAR)
    cv2.polylines(over, [np.rint((points + 0.5) * 4 - 0.5).astype(np.int32)], False, float(grey), max(1, round(4 * width)))
    return cv2.resize(over, image.shape[::-1], interpolation=cv2.INTER_AREA), points


def off(sighting, points, camera=CAMERA):
    """Mean distance of a sighting from a wire's points [px]."""
    pixels = camera.project(sighting.rays_C)[0]
    return np.linalg.norm(pixels[:, None] - points[None], axis=2).min(axis=1).mean()


@pytest.mark.parametrize("grey", [20, 200], ids=["dark", "bright"])
@pytest.mark.parametrize("width", [1.2, 4.0, 9.0])
def test_thin_and_thick_wires_of_either_sign_are_found_before_woods(grey, width):
    """Two wires that cross the image, found to half a pixel; whatever else is found is less than they are."""
    image, first = strung(woods(np.random.default_rng(1)), [(0, 130), (640, 210)], grey, width, bend=8.0)
    image, second = strung(image, [(0, 260), (640, 330)], grey, width)
    found = detect_lines(cv2.GaussianBlur(image, (0, 0), 0.7), CAMERA, PLAIN)
    for points in (first, second):
        assert min(off(one, points) for one in found) < 0.8
        assert sum(off(one, points) < 3.0 for one in found) == 1, "once, not its rims as well"
    assert len(found) <= 3


def test_woods_alone_are_no_wires():
    assert sum(len(detect_lines(woods(np.random.default_rng(seed)), CAMERA, PLAIN)) for seed in range(6)) <= 1


def test_a_short_line_counts_beside_a_parallel_wire_only():
    image = woods(np.random.default_rng(3))
    alone, _ = strung(image, [(150, 350), (400, 390)], 200, 2.0)
    alone[:, 440:] = image[:, 440:]
    alone[:, :110] = image[:, :110]
    assert detect_lines(alone, CAMERA, PLAIN) == []
    both, _ = strung(alone, [(0, 150), (640, 250)], 200, 2.0)
    assert len(detect_lines(both, CAMERA, PLAIN)) == 2


def test_the_border_of_two_surfaces_is_no_wire():
    """A kerb: a bright line, but tarmac on one side and grass on the other. The same line with tarmac on both sides is one."""
    rng, (v, u) = np.random.default_rng(4), np.mgrid[:480, :640]
    below = v - 200 > 0.2 * (u - 320)
    noise = cv2.GaussianBlur(rng.standard_normal((480, 640)), (0, 0), 2.0) * 25.0
    for grass, lines in ((170, 0), (90, 1)):
        image = np.clip(np.where(below, grass, 90) + noise, 0, 255).astype(np.uint8)
        image, _ = strung(image, [(0, 136), (640, 264)], 200, 3.0)
        assert len(detect_lines(image, CAMERA, PLAIN)) == lines


def test_a_straight_wire_under_a_fisheye_is_one():
    fisheye = EquidistantCamera(640, 480, 275.0, 275.0, 320.0, 240.0, (0.003908, -0.009574, 0.010173, -0.003329))
    points = np.stack([np.linspace(-6, 6, 4000), np.full(4000, -1.2), np.full(4000, 1.5)], axis=1)
    pixels = fisheye.project(points)[0]
    image = np.full((480, 640), 110, np.uint8)
    cv2.polylines(image, [np.rint(pixels).astype(np.int32)], False, 200, 2)
    (one,) = detect_lines(cv2.GaussianBlur(image, (0, 0), 0.8), fisheye, PLAIN)
    normal = np.array([0.0, 1.5, 1.2]) / np.linalg.norm([1.5, 1.2])
    assert np.abs(one.rays_C @ normal).max() * 275 < 1.0 and one.length > 400


@pytest.mark.parametrize("angle_deg", [0.0, 37.0, 90.0, 151.0])
def test_ridge_points_lie_on_the_middle_of_a_line_and_an_edge_is_no_wire(angle_deg):
    v, u = np.mgrid[:240, :320].astype(float)
    across = (v - 120) * np.cos(np.radians(angle_deg)) - (u - 160) * np.sin(np.radians(angle_deg))
    line, edge = (cv2.GaussianBlur(np.where(inside, 60.0, 140.0), (0, 0), 0.6) for inside in (np.abs(across) < 1.9, across < 0.0))
    found, inner = ridges(line.astype(np.uint8)), lambda r: np.all(np.abs(r.pixels - (159.5, 119.5)) < 80, axis=1)
    at = ((found.pixels[:, 1] - 120) * np.cos(np.radians(angle_deg)) - (found.pixels[:, 0] - 160) * np.sin(np.radians(angle_deg)))
    dark = inner(found) & (found.bend > 0) & (np.abs(at) < 2.0)
    assert dark.sum() > 100 and abs(np.median(at[dark])) < 0.3
    assert np.median(np.abs(found.tangents[dark] @ [np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))])) > 0.999
    assert len(detect_lines(line.astype(np.uint8), SMALL, PLAIN)) == 1 and detect_lines(edge.astype(np.uint8), SMALL, PLAIN) == []


def flight(renderer, mapper, backdrop, steps=14):
    """The map after 0.8 m upwards, and what the backdrop said of each sighting of a mapped wire."""
    rng, said = np.random.default_rng(0), []

    def attached(one, curve):
        said.append(backdrop.is_on_surface(one, curve))
        return said[-1]

    for k, share in enumerate(np.linspace(0.0, 1.0, steps)):
        p, R = np.array([0.0, 0.0, 1.8 + 0.8 * share]), so3.exp(np.array([0.02, -0.2 + 0.05 * np.sin(7 * share), 0.0]))
        body = BodyState(0.1 * k, p, so3.quat_from_matrix(R @ so3.exp(5e-4 * rng.standard_normal(3))), np.zeros(3),
                         np.zeros(3), np.diag([2.5e-5] * 3 + [1e-5] * 3))
        image = cv2.cvtColor(renderer.render([(p, R)], rng), cv2.COLOR_RGB2GRAY)
        backdrop.add_image(image, body.time, *MOUNT.pose(body.p_WB, body.R_WB))
        result = mapper.update(0.1 * k, body, [place(one, body, MOUNT) for one in detect_lines(image, MOUNT.camera, PLAIN)], attached)
    return result, said


def test_maps_grey_wires_within_three_centimetres_and_sees_that_they_hang_free():
    cables = [Catenary.from_sag(np.array([3.0, -4.0, 2.6]), np.array([3.0, 4.0, 2.8]), 0.1),
              Catenary.from_sag(np.array([3.6, -4.0, 2.1]), np.array([3.2, 4.0, 2.0]), 0.1)]
    result, said = flight(Renderer(scene(cables), MOUNT, seed=1), LineMapper(MapperConfig()), BackgroundCheck(MOUNT.camera))
    assert len({line.segment.id % 100 for line in result.lines}) == 2
    for cable in cables:
        points = cable.sample(200)
        points = points[np.abs(points[:, 1]) < 1.5]
        assert np.mean(np.min([line.segment.distance(points) for line in result.lines], axis=0)) < 0.03
    assert all(line.segment.radius == 0.03 for line in result.lines), "the width of a plain wire is not measured"
    assert said.count(False) > 5 and said.count(True) == 0


def test_a_line_on_the_wall_is_seen_to_move_with_it_and_is_not_mapped():
    seam = Catenary.from_sag(np.array([3.99, -4.4, 2.6]), np.array([3.99, 4.4, 2.4]), 0.001)
    result, said = flight(Renderer(scene([seam], wall=4.0), MOUNT, seed=1), LineMapper(MapperConfig()), BackgroundCheck(MOUNT.camera))
    assert said.count(True) >= 3 and said.count(False) == 0
    assert result.lines == ()


def test_texture_alone_is_no_wire():
    renderer = Renderer(scene([], contrast=0.25), MOUNT, seed=1)
    for k in range(2):
        pose = np.array([0.0, 0.3 * k, 2.0]), so3.exp(np.array([0.0, 0.1, 0.4 * k]))
        assert detect_lines(renderer.render([pose], np.random.default_rng(k)), MOUNT.camera, PLAIN) == []


def test_takes_grey_images_too():
    image = np.full((480, 640), 130, np.uint8)
    image[200:206] = 80
    (one,) = detect_lines(image, CAMERA, PLAIN)
    np.testing.assert_allclose(CAMERA.project(one.rays_C)[0][:, 1], 202.5, atol=0.5)
