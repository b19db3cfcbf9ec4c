"""Cables in the image against brute-force rays, the camera model and what a line detector needs."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from perch_core.camera import EquidistantCamera, PinholeCamera
from perch_core.camera_mount import CameraMount
from perch_core.catenary import Catenary
from perch_core.surface import PerchSurface
from perch_sim.rendering import CableCurve, Renderer, Scene, build_scene
from perch_sim.rendering.renderer import spread
from perch_sim.scenario import Cable, Scenario, World
from unit.camera_mounts import looking_along

FISHEYE = EquidistantCamera(640, 480, 275.0, 275.0, 320.0, 240.0, (0.003908, -0.009574, 0.010173, -0.003329))
PINHOLE = PinholeCamera(640, 480, 385.0, 385.0, 320.0, 240.0)
AHEAD = looking_along([1, 0, 0], [0, 0, 1])
HERE = (np.array([0.0, 0.0, 2.0]), np.eye(3))
BLACK = (0.0, 0.0, 0.0)


def plain_room(*cables: CableCurve, **changes) -> Scene:
    """A room of one colour per wall."""
    return Scene(**{"room_low": [-1, -4.2, 0], "room_high": [6, 4.2, 4.6], "contrast": 0.0, "cables": cables} | changes)


BARE = plain_room()


def light(scene: Scene, camera, pose=HERE, colour: bool = False) -> np.ndarray:
    mount = CameraMount("front", camera, np.zeros(3), AHEAD, colour=colour)
    return Renderer(scene, mount)._light(*mount.pose(*pose), np.zeros(3)).astype(float)


def covered(scene: Scene, camera, pose=HERE) -> np.ndarray:
    """Share of each pixel that black cables cover, as drawn; shape (height, width)."""
    return 1.0 - light(scene, camera, pose) / light(BARE, camera, pose)


def covered_by_rays(cable: CableCurve, camera, window, pose=HERE) -> np.ndarray:
    """The same by 16 x 16 rays per pixel, each measured against the finite axis of every piece of the polyline."""
    top, bottom, left, right = window
    at = (np.arange(16) + 0.5) / 16 - 0.5
    v, u = np.meshgrid((np.arange(top, bottom)[:, None] + at).ravel(), (np.arange(left, right)[:, None] + at).ravel(),
                       indexing="ij")
    p_WB, R_WB = pose
    rays = (camera.unproject(np.stack([u, v], -1)) @ (R_WB @ AHEAD).T).reshape(-1, 3)
    hit = np.zeros(len(rays), dtype=bool)
    for a, b in zip(cable.points_W[:-1] - p_WB, cable.points_W[1:] - p_WB):
        length = np.linalg.norm(b - a)
        axis = (b - a) / length
        normal = np.cross(rays, axis)
        sine = np.linalg.norm(normal, axis=1)
        along = (rays @ axis * (rays @ a) - a @ axis) / sine**2
        ahead = rays @ a + along * (rays @ axis) > 0
        hit |= ahead & (np.abs(normal @ a) / sine < cable.radius) & (along >= 0) & (along <= length)
    return hit.reshape(bottom - top, 16, right - left, 16).mean(axis=(1, 3))


def straight(start, end, radius: float, colour=BLACK) -> CableCurve:
    return CableCurve(np.array([start, end], dtype=float), radius, colour)


@pytest.mark.parametrize("camera, start, end, radius", [
    (FISHEYE, [4, -4, 2.5], [4, 4, 2.8], 0.03), (PINHOLE, [4, -4, 2.5], [4, 4, 2.8], 0.03), (PINHOLE, [4, -4, 1.4], [5, 4, 1.5], 0.004),
    (FISHEYE, [0.5, -4, 2.1], [0.6, 4, 2.15], 0.03), (PINHOLE, [2, 0.3, 0.5], [2, 0.1, 4.5], 0.015)],
    ids=["far, fisheye", "far, pinhole", "thinner than a pixel, pinhole", "close, fisheye", "upright, pinhole"])
def test_coverage_is_that_of_brute_force_rays(camera, start, end, radius):
    cable = straight(start, end, radius)
    window = (120, 300, 315, 345) if abs(end[1] - start[1]) > 1 else (200, 225, 220, 330)
    drawn = covered(plain_room(cable), camera)[window[0]:window[1], window[2]:window[3]]
    rays = covered_by_rays(cable, camera, window)
    assert rays.sum() > 10
    assert np.sqrt(np.mean((drawn - rays)[rays > 0] ** 2)) < 0.06
    assert drawn.sum() == pytest.approx(rays.sum(), rel=0.02)


@pytest.mark.parametrize("radius", [0.001, 0.002, 0.004, 0.02])
def test_width_in_the_image_is_the_wires_width(radius):
    """Across a wire at 4 m the covered pixels add up to 2 r f / d, however thin it is."""
    drawn = covered(plain_room(straight([4, -4, 2.3], [4, 4, 2.3], radius)), PINHOLE)
    widths = drawn[:, 200:440].sum(axis=0)
    assert widths.mean() == pytest.approx(2 * radius * PINHOLE.fy / 4.0, rel=0.03)


def test_a_panel_hides_what_is_behind_it_and_nothing_else():
    behind, before = straight([5, -4, 2.2], [5, 4, 2.2], 0.03), straight([2, -4, 1.8], [2, 4, 1.8], 0.03)
    panel = PerchSurface.from_inclination([3, 0, 2], np.pi / 2, size=(2.0, 1.0))
    shown = light(plain_room(behind, before, target=panel), PINHOLE)
    bare = light(plain_room(target=panel), PINHOLE)
    difference = np.abs(shown - bare)
    row_behind, row_before = (int(240 - PINHOLE.fy * dz / x) for dz, x in ((0.2, 5), (-0.2, 2)))
    left, right = (int(320 + PINHOLE.fx * y / 3.0) for y in (-0.5, 0.5))
    assert difference[row_behind - 4: row_behind + 5, left + 2: right - 1].max() == 0
    assert difference[row_behind, 20:left - 2].min() > 50 and difference[row_behind, right + 3:600].min() > 50
    assert difference[row_before, 100:540].min() > 50


def test_the_nearer_cable_covers_the_farther():
    far, near = straight([4, -4, 2], [4, 4, 2], 0.03, (250.0,) * 3), straight([2, 0, 0], [2, 0, 4], 0.03)
    image = light(plain_room(near, far), PINHOLE)
    assert image[240, 320] == 0 and image[240, 250] > 140
    np.testing.assert_array_equal(image, light(plain_room(far, near), PINHOLE))


def test_a_near_wire_is_blurred_by_its_own_motion():
    """Against many instants of the exposure; the walls, 2 m away and more, move by a quarter of that."""
    wire = CableCurve(np.array([[0.5, 0.0, 0.5], [0.5, 0.0, 3.5]]), 0.005, BLACK)
    camera = PinholeCamera(80, 20, 385.0, 385.0, 40.0, 10.0)
    renderer = Renderer(plain_room(wire), CameraMount("front", camera, np.zeros(3), AHEAD))
    p, R = HERE
    poses = [(p, R), (p + [0.0, 0.01, 0.0], R)]                    # 7.7 px

    def mean(count: int) -> np.ndarray:
        lights = [renderer._light(*renderer.mount.pose(*pose), np.zeros(3)).astype(float) for pose in spread(poses, count)]
        return np.mean(lights, axis=0)[10]

    exact = mean(40)
    assert np.abs(mean(renderer._subframes(poses, np.zeros((2, 3)))) - exact).max() < 0.2 * np.ptp(exact)


def test_red_cables_are_red_and_the_textured_room_is_not():
    scene = plain_room(straight([4, -4, 2.3], [4, 4, 2.3], 0.03, (190.0, 35.0, 35.0)), contrast=0.3)
    mount = CameraMount("front", PINHOLE, np.zeros(3), AHEAD, colour=True)
    image = Renderer(scene, mount).render([HERE], np.random.default_rng(0))
    assert image.shape == (480, 640, 3) and image.dtype == np.uint8
    redness = image[..., 0].astype(int) - image[..., 1:].max(axis=-1)
    row = round(240 - PINHOLE.fy * 0.3 / 4)
    assert np.median(redness[row, 100:540]) > 60
    away = np.vstack([redness[: row - 6], redness[row + 7:]])
    assert np.percentile(away, 99.9) < 25


def test_no_pose_breaks_it():
    rng = np.random.default_rng(3)
    cable = Catenary.from_sag([3, -4, 3], [3.5, 4, 3.2], 0.4)
    scene = plain_room(CableCurve(cable.sample(60), 0.03, (190.0, 35.0, 35.0)))
    renderers = [Renderer(scene, CameraMount("front", camera, np.zeros(3), AHEAD)) for camera in (FISHEYE, PINHOLE)]
    for _ in range(15):
        place = cable.point(rng.uniform(0, cable.length)) + rng.normal(0, 0.06, 3)
        attitude = Rotation.random(random_state=rng).as_matrix()
        for renderer in renderers:
            assert renderer.render([(place, attitude)], rng).shape == (480, 640)


def test_scenario_cables_hang_where_the_scenario_says():
    cable = Cable(start=(4.0, -4.0, 2.6), end=(4.0, 4.0, 2.6), sag=0.5, radius=0.02, colour="grey")
    world = World(room=(12.0, 9.0, 5.0), cables=(cable,), contrast=0.0)
    scenario = Scenario(name="lines", mode="powerline", world=world)
    scene = build_scene(scenario)
    assert scene.target is None and len(scene.cables) == 1
    image = light(scene, PINHOLE)
    bare = light(Scene(scene.room_low, scene.room_high, contrast=0.0), PINHOLE)
    rows = np.abs(image - bare)[:, 320]
    assert np.average(np.arange(480), weights=rows) == pytest.approx(240 - PINHOLE.fy * 0.1 / 4.0, abs=0.2)


@pytest.mark.parametrize("sag", [0.0, 0.5, 4.0])
def test_a_scenarios_cable_is_drawn_within_a_millimetre_however_it_sags(sag):
    cable = Cable(start=(4.0, -2.0, 5.0), end=(4.0, 2.0, 5.5), sag=sag)
    drawn = build_scene(Scenario(name="lines", mode="powerline", world=World(cables=(cable,)))).cables[0].points_W
    start, piece = drawn[:-1], np.diff(drawn, axis=0)
    for p in cable.catenary().sample(700):
        along = np.clip(((p - start) * piece).sum(axis=1) / (piece * piece).sum(axis=1), 0.0, 1.0)
        assert np.linalg.norm(start + along[:, None] * piece - p, axis=1).min() < 1e-3
