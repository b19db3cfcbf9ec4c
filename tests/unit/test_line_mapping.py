"""Wires: their shape, detection, triangulation with degenerate baselines, association, and the map from rendered images."""

import numpy as np
import pytest
from perch_core import so3
from perch_core.camera import EquidistantCamera, PinholeCamera
from perch_core.catenary import Catenary
from perch_core.vehicle import load_vehicle
from perch_perception.line_mapping import (
    DegenerateBaseline, LineDetectionConfig, LineMapper, LineObservation, MapperConfig, TriangulationConfig, WireCurve,
    detect_lines, place, triangulate)
from perch_perception.pose_buffer import BodyState
from perch_sim.rendering import CableCurve, Renderer, Scene
from scipy.optimize import minimize_scalar
from scipy.stats import chi2

MOUNT = load_vehicle("rpg").mounts["front"]
SETTINGS = TriangulationConfig()
RED = (190.0, 35.0, 35.0)


# -- the curve -----------------------------------------------------------------------------------------------------------

WIRE = WireCurve(np.array([3.0, 0.4, 2.5]), np.array([0.1, 0.98, 0.17]) / np.linalg.norm([0.1, 0.98, 0.17]), 0.02)


def test_curve_follows_a_hanging_cable():
    """Against the catenary: 16 cm of sag over 8 m is kappa = 0.02, and the parabola stays within 2 mm of it."""
    cable = Catenary.from_sag(np.array([3.0, -4.0, 2.5]), np.array([3.0, 4.0, 2.5]), 0.16)
    curve = WireCurve(np.array([3.0, 0.0, 2.34]), np.array([0.0, 1.0, 0.0]), 0.02)
    points = cable.sample(50)
    np.testing.assert_allclose(curve.at(points[:, 1]), points, atol=2e-3)


def test_nearest_point_agrees_with_a_search():
    rng = np.random.default_rng(0)
    centres = rng.normal(0, 0.3, (20, 3)) + [0, 0, 2]
    rays = WIRE.at(rng.uniform(-2, 2, 20)) + rng.normal(0, 0.02, (20, 3)) - centres
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    for centre, ray, s in zip(centres, rays, WIRE.nearest(centres, rays)):
        best = minimize_scalar(lambda x: np.linalg.norm(np.cross(ray, WIRE.at(np.array(x)) - centre)),
                               bounds=(-4, 4), method="bounded", options={"xatol": 1e-9})
        assert s == pytest.approx(best.x, abs=2e-3)


def test_jacobian_of_the_offsets_against_finite_differences():
    rng = np.random.default_rng(1)
    centres = rng.normal(0, 0.3, (30, 3)) + [0, 0, 2]
    rays = WIRE.at(rng.uniform(-2, 2, 30)) + rng.normal(0, 0.005, (30, 3)) - centres
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    jacobian = WIRE.offsets(centres, rays).jacobian
    for k in range(5):
        step = np.zeros(5)
        step[k] = 1e-5
        numeric = (WIRE.moved(step).offsets(centres, rays).angles - WIRE.moved(-step).offsets(centres, rays).angles) / 2e-5
        np.testing.assert_allclose(jacobian[:, k], numeric, atol=0.02 * np.abs(numeric).max())


# -- triangulation -------------------------------------------------------------------------------------------------------

def observe(rng, curve, centre, noise=0.0, span=(-2.0, 2.0), time=0.0, sigma=5e-4):
    rays = curve.at(np.linspace(*span, 7)) - centre
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    across = np.cross(rays, curve.tangent(0.0))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    rays = rays + noise * rng.standard_normal((7, 1)) * across
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return LineObservation(time, centre, rays, rays[[0, -1]], sigma, 0.005)


def test_exact_sightings_give_the_exact_wire():
    rng = np.random.default_rng(2)
    seen = [observe(rng, WIRE, np.array([0.0, 0.1 * k, 2.0 + 0.1 * k])) for k in range(9)]
    wire = triangulate(seen, TriangulationConfig(sag=1.0)).curve
    s = np.linspace(-1.5, 1.5, 7)
    nearest = np.array([WIRE.at((p - WIRE.point) @ WIRE.direction) for p in wire.at(s)])
    np.testing.assert_allclose(wire.at(s), nearest, atol=2e-3)


@pytest.mark.parametrize("motion", [WIRE.direction, (WIRE.point - [0, 0, 2]) / np.linalg.norm(WIRE.point - [0, 0, 2])],
                         ids=["along the wire", "towards it"])
def test_degenerate_motion_is_refused_with_its_ratio(motion):
    rng = np.random.default_rng(3)
    line = WireCurve(WIRE.point, WIRE.direction)
    seen = [observe(rng, line, np.array([0.0, 0.0, 2.0]) + 0.1 * k * motion, noise=1e-3) for k in range(10)]
    with pytest.raises(DegenerateBaseline, match="move across the wire") as refusal:
        triangulate(seen, SETTINGS)
    assert refusal.value.ratio < 0.03


def test_covariance_matches_the_errors_it_predicts():
    """NEES of the wire's middle, across it, with errors of rays and poses as configured: inside the 99.9 % bounds."""
    rng = np.random.default_rng(4)
    values = []
    for _ in range(120):
        seen = []
        for k in range(10):
            centre = np.array([0.0, 0.05 * k, 1.6 + 0.1 * k])
            true = observe(rng, WIRE, centre, noise=5e-4)
            turn = so3.exp(np.radians(SETTINGS.pose_rotation) * rng.standard_normal(3))
            seen.append(LineObservation(0.0, centre + SETTINGS.pose_position * rng.standard_normal(3),
                                        true.rays_W @ turn.T, true.ends_W @ turn.T, 5e-4, 0.005))
        wire = triangulate(seen, SETTINGS)
        point = wire.curve.at(np.array(0.0))
        error = WIRE.at((point - WIRE.point) @ WIRE.direction) - point
        axes = wire.curve.axes[:, :2]
        values.append((axes.T @ error) @ np.linalg.solve(axes.T @ wire.point_covariance(0.0) @ axes, axes.T @ error))
    low, high = chi2.ppf([0.0005, 0.9995], 2 * len(values)) / len(values)
    assert 0.7 * low < np.mean(values) < high  # the fit's own robust weights make it a little cautious


def test_a_camera_that_is_mounted_askew_does_not_make_the_map_sure_of_itself():
    """Its error is the same in all sightings, and does not average out: errors in sigmas with and without knowing that."""
    wire, corners = WireCurve(np.array([5.0, 0.0, 4.75]), np.array([0.0, 1.0, 0.0])), np.array(
        [[0.0, 0.0, 4.2], [0.0, 0.0, 5.0], [1.6, 0.0, 5.0], [1.6, 0.0, 4.2], [0.0, 0.0, 4.2]])
    path = np.concatenate([np.linspace(a, b, 8, endpoint=False) for a, b in zip(corners, corners[1:])])
    nees, errors = {}, {}
    for sigma in (1e-4, 0.3):
        rng, found, off = np.random.default_rng(12), [], []
        for _ in range(25):
            askew, seen = so3.exp(np.radians(0.3) * rng.standard_normal(3)), []
            for k, centre in enumerate(path):
                true = observe(rng, wire, centre, noise=2e-4)
                seen.append(LineObservation(0.3 * k, centre, true.rays_W @ askew.T, true.ends_W @ askew.T, 5e-4, 0.005))
            estimate = triangulate(seen, TriangulationConfig(mount_rotation=sigma))
            point, axes = estimate.curve.at(np.array(0.0)), estimate.curve.axes[:, :2]
            error = axes.T @ (wire.at((point - wire.point) @ wire.direction) - point)
            found.append(error @ np.linalg.solve(axes.T @ estimate.point_covariance(0.0) @ axes, error))
            off.append(error @ error)
        nees[sigma], errors[sigma] = float(np.mean(found)), float(np.sqrt(np.mean(off)))
    assert nees[0.3] < 3.0 < nees[1e-4], nees
    assert errors[0.3] < errors[1e-4], errors


def test_a_wrong_sighting_is_left_out():
    rng = np.random.default_rng(5)
    other = WireCurve(WIRE.point + [0.0, 0.0, 0.5], WIRE.direction, 0.02)
    seen = [observe(rng, other if k == 4 else WIRE, np.array([0.0, 0.0, 1.6 + 0.1 * k]), noise=2e-4) for k in range(9)]
    wire = triangulate(seen, SETTINGS)
    assert not wire.used[4] and wire.used.sum() == 8
    point = wire.curve.at(np.array(0.0))
    assert np.linalg.norm(WIRE.at((point - WIRE.point) @ WIRE.direction) - point) < 0.03


# -- detection -----------------------------------------------------------------------------------------------------------

def cables(sag, radius=0.012, colour=RED):
    hanging = [Catenary.from_sag(np.array(a), np.array(b), sag) for a, b in (
        ([3.0, -4.0, 2.6], [3.0, 4.0, 2.8]), ([3.6, -4.0, 2.1], [3.2, 4.0, 2.0]), ([3.3, -4.0, 3.3], [3.9, 4.0, 3.1]))]
    scene = Scene(np.array([-3.0, -4.5, 0.0]), np.array([9.0, 4.5, 6.0]), contrast=0.25, seed=1,
                  cables=tuple(CableCurve(cable.sample(60), radius, colour) for cable in hanging))
    return hanging, scene


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


# -- the map -------------------------------------------------------------------------------------------------------------

class Flight:
    """Images along a path, with the estimator's errors: a drift, a turned camera, and noise from image to image."""

    def __init__(self, renderer, seed):
        self.renderer, self.rng = renderer, np.random.default_rng(seed)
        self.drift = np.array([0.005, 0.005, 0.005]) * self.rng.standard_normal(3)
        self.turn = so3.exp(np.radians(0.2) * self.rng.standard_normal(3))
        self.mapper = LineMapper(MapperConfig(radius=0.012))
        self.maps = []

    def fly(self, start, end, images):
        for k, share in enumerate(np.linspace(0.0, 1.0, images)):
            p = np.array(start) + share * (np.array(end) - np.array(start))
            R = so3.exp(np.array([0.04 * np.sin(5 * share), -0.2 + 0.05 * np.sin(7 * share), 0.03 * np.sin(9 * share)]))
            image = self.renderer.render([(p, R)], self.rng)
            noise = so3.exp(np.radians(0.03) * self.rng.standard_normal(3))
            body = BodyState(0.1 * len(self.maps), p + self.drift + 0.001 * self.rng.standard_normal(3),
                             so3.quat_from_matrix(noise @ self.turn @ R), np.zeros(3), np.zeros(3),
                             np.diag([2.5e-5] * 3 + [1.2e-5] * 3))
            seen = [place(one, body, MOUNT) for one in detect_lines(image, MOUNT.camera, LineDetectionConfig())]
            self.maps.append(self.mapper.update(body.time, body, seen))
        return self.maps[-1]


def map_errors(lines, cable, around, reach=1.5):
    """Distances [m] of a cable's points within `reach` of y = `around` from the nearest mapped segment."""
    points = cable.sample(400)
    points = points[np.abs(points[:, 1] - around) < reach]
    return np.min([line.segment.distance(points) for line in lines], axis=0)


@pytest.mark.parametrize(("start", "end"), [((0.0, 0.0, 1.8), (0.0, 0.0, 2.6)), ((0.0, -0.2, 1.9), (0.3, 0.2, 2.55))],
                         ids=["0.8 m up", "0.8 m askew"])
def test_maps_within_three_centimetres_from_a_motion_of_80_cm(wires, start, end):
    hanging, renderer = wires
    errors = []
    for seed in range(4):
        result = Flight(renderer, seed).fly(start, end, 16)
        ids = [line.segment.id % 100 for line in result.lines]
        assert len(set(ids)) == 3 and not result.degenerate, result.message
        errors += [np.mean(map_errors(result.lines, cable, 0.0)) for cable in hanging]
        for line in result.lines:
            assert line.segment.radius == pytest.approx(0.012, rel=0.5)
    assert np.mean(errors) <= 0.03
    assert np.max(errors) <= 0.06


def test_ids_are_stable_and_the_extent_is_what_was_seen(wires):
    hanging, renderer = wires
    flight = Flight(renderer, 7)
    flight.fly((0.0, 0.0, 1.8), (0.0, 0.0, 2.6), 14)
    before = {line.segment.id: line.segment for line in flight.maps[-1].lines}
    flight.fly((0.0, 0.0, 2.6), (0.0, 0.3, 2.2), 8)
    after = {line.segment.id: line.segment for line in flight.maps[-1].lines}
    assert set(before) == set(after)
    for number, segment in before.items():
        assert segment_gap(segment, after[number]) < 0.05
    # 640 px at f = 385 px see 0.83 of the distance (3 to 4 m) to either side, and the camera moves by 0.3 m
    assert all(1.5 < abs(end[1]) < 3.9 for s in whole(after).values() for end in s)


def segment_gap(a, b):
    return float(np.linalg.norm(np.cross(b.centre - a.centre, a.direction)))


def whole(segments):
    """Outer ends of each wire over its pieces."""
    out = {}
    for number, segment in segments.items():
        ends = np.concatenate([np.array(segment.ends), out.get(number % 100, np.zeros((0, 3)))])
        out[number % 100] = ends[[np.argmin(ends[:, 1]), np.argmax(ends[:, 1])]]
    return out


def test_motion_along_the_wires_is_called_degenerate(wires):
    _, renderer = wires
    result = Flight(renderer, 3).fly((0.0, -0.5, 2.2), (0.0, 0.5, 2.2), 12)
    assert result.degenerate and result.lines == ()
    assert "baseline ratio" in result.message and "move across" in result.message


def test_sightings_that_could_be_either_wire_change_nothing():
    """Two wires that coincide from where the camera is: the sighting is left alone."""
    rng = np.random.default_rng(8)
    near, far = WireCurve(np.array([2.0, 0.0, 2.0]), np.array([0.0, 1.0, 0.0])), \
        WireCurve(np.array([4.0, 0.0, 2.02]), np.array([0.0, 1.0, 0.0]))
    mapper = LineMapper(MapperConfig())
    for k in range(12):
        centre = np.array([0.0, 0.0, 1.4 + 0.04 * k])
        body = BodyState(0.1 * k, centre, np.array([0, 0, 0, 1.0]), np.zeros(3), np.zeros(3), np.eye(6) * 1e-6)
        mapper.update(0.1 * k, body, [observe(rng, w, centre, 2e-4, time=0.1 * k) for w in (near, far)])
    before = mapper.map(1.2)
    assert len(before.lines) == 2
    centre = np.array([0.0, 0.0, 2.0])
    body = BodyState(1.3, centre, np.array([0, 0, 0, 1.0]), np.zeros(3), np.zeros(3), np.eye(6) * 1e-6)
    after = mapper.update(1.3, body, [observe(rng, near, centre, 2e-4, time=1.3)])
    assert [line.observations for line in after.lines] == [line.observations for line in before.lines]


def test_false_sightings_are_forgotten():
    rng = np.random.default_rng(9)
    mapper = LineMapper(MapperConfig(forget_after=1.0))
    body = BodyState(0.0, np.array([0, 0, 2.0]), np.array([0, 0, 0, 1.0]), np.zeros(3), np.zeros(3))
    mapper.update(0.0, body, [observe(rng, WIRE, np.array([0, 0, 2.0]))])
    assert len(mapper._tracks) == 1
    mapper.update(1.5, body, [])
    assert mapper._tracks == []


def test_the_map_follows_an_odometry_that_drifts():
    """What the newest sightings say counts more than what the oldest did: the vehicle will fly there from where it is now."""
    wire, errors = WireCurve(np.array([3.0, 0.0, 2.5]), np.array([0.0, 1.0, 0.0])), {}
    for drift in (0.0, 0.01):  # of the mapper; the odometry's own is 1 cm/s
        rng, mapper = np.random.default_rng(10), LineMapper(MapperConfig(triangulation=TriangulationConfig(pose_drift=drift)))
        for k in range(100):
            time, true = 0.1 * k, np.array([0.0, 0.0, 1.6 + 0.8 * abs((k / 15) % 2 - 1)])  # up and down
            believed = true + time * np.array([0.003, 0.0, -0.01])
            body = BodyState(time, believed, np.array([0, 0, 0, 1.0]), np.zeros(3), np.zeros(3), np.eye(6) * 1e-6)
            seen = observe(rng, wire, true, 2e-4, time=time)
            lines = mapper.update(time, body, [LineObservation(time, believed, seen.rays_W, seen.ends_W, seen.sigma, seen.width)]).lines
        assert len(lines) == 1
        errors[drift] = np.linalg.norm((lines[0].segment.centre - [3.0, 0.0, 2.5] - believed + true)[[0, 2]])
    assert errors[0.01] < 0.3 * errors[0.0] and errors[0.01] < 0.025, errors


def test_a_wire_that_is_seen_anew_beside_its_old_place_replaces_it():
    """The odometry was corrected by more than sightings are associated over: one wire must not become two obstacles."""
    rng, mapper = np.random.default_rng(11), LineMapper(MapperConfig())
    wire, jump = WireCurve(np.array([3.0, 0.0, 2.5]), np.array([0.0, 1.0, 0.0])), np.array([0.0, 0.0, -0.25])
    for k in range(80):
        time, true = 0.1 * k, np.array([0.0, 0.0, 1.6 + 0.8 * abs((k / 15) % 2 - 1)])
        believed = true + (jump if k >= 30 else 0.0)
        body = BodyState(time, believed, np.array([0, 0, 0, 1.0]), np.zeros(3), np.zeros(3), np.eye(6) * 1e-6)
        seen = observe(rng, wire, true, 2e-4, time=time)
        lines = mapper.update(time, body, [LineObservation(time, believed, seen.rays_W, seen.ends_W, seen.sigma, seen.width)]).lines
    assert len(lines) == 1
    assert np.linalg.norm((lines[0].segment.centre - [3.0, 0.0, 2.5] - jump)[[0, 2]]) < 0.03
