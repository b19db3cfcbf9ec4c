"""The map of wires: from rendered images, its ids and extents, and what changes it."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from oracles.wires import MOUNT, WIRE, cables, observe
from perch_core import so3
from perch_perception.line_mapping import (
    LineDetectionConfig, LineMapper, MapperConfig, TriangulationConfig, WireCurve, WireEstimate, detect_lines, place)
from perch_perception.line_mapping.association import meets_another
from perch_perception.line_mapping.mapper import PIECE_IDS, _same_wire
from perch_perception.pose_buffer import BodyState, PoseBuffer, StampError
from perch_perception.powerline_mapper import mapping_pose
from perch_sim.rendering import CableCurve, Renderer, Scene


@pytest.fixture(scope="module")
def wires():
    hanging, scene = cables(0.1)
    return hanging, Renderer(scene, MOUNT, seed=1)


class Flight:
    """Images along a path, with the estimator's errors: a drift, a turned camera, and noise from image to image."""

    def __init__(self, renderer, seed):
        self.renderer, self.rng = renderer, np.random.default_rng(seed)
        self.drift = np.array([0.005, 0.005, 0.005]) * self.rng.standard_normal(3)
        self.turn = so3.exp(np.radians(0.2) * self.rng.standard_normal(3))
        self.mapper = LineMapper(MapperConfig(triangulation=TriangulationConfig(radius=0.012)))
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


def test_wires_that_cross_in_the_image_are_where_they_are_once_they_are_seen_apart():
    """Before and after they cross they are one blob, whose middle is neither's, and would put the near one 17 cm too far away."""
    ends = [(x, z) for x, z in ((4.0, 4.25), (5.0, 3.75), (5.0, 4.75))]
    scene = Scene(np.array([-4.0, -4.5, 0.0]), np.array([10.0, 4.5, 8.0]), contrast=0.25, seed=1, cables=tuple(
        CableCurve(np.linspace([x, -2.0, z], [x, 2.0, z], 30), 0.03, (190.0, 35.0, 35.0)) for x, z in ends))
    flight = Flight(Renderer(scene, MOUNT, seed=1), 1)
    flight.drift, flight.turn = np.zeros(3), np.eye(3)
    found = flight.fly((0.0, 0.0, 1.5), (0.0, 0.0, 4.3), 46).lines
    assert len(found) == 3
    for x, z in ends:
        wire = min((line.segment for line in found), key=lambda one: float(one.distance(np.array([x, 0.0, z]))))
        assert wire.distance(np.array([x, 0.0, z])) < 0.04 and wire.radius == pytest.approx(0.03, rel=0.02)


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


ACROSS = WireCurve(np.array([3.0, 0.0, 2.2]), np.array([0.0, 1.0, 0.0]))


def mapped(spans, wire=ACROSS, begin=1.6, step=0.1, attitude=1e-3, stop=100):
    """The map after a climb up to image `stop`, in each image of which a span of the wire is seen; `attitude`: 1 sigma of the vehicle's [rad]."""
    rng, mapper = np.random.default_rng(17), LineMapper(MapperConfig())
    for k, span in enumerate(spans):
        centre = np.array([0.0, 0.0, begin + step * min(k, stop)])
        body = BodyState(0.1 * k, centre, np.array([0, 0, 0, 1.0]), np.zeros(3), np.zeros(3), np.diag([1e-6] * 3 + [attitude**2] * 3))
        result = mapper.update(body.time, body, [observe(rng, wire, centre, 1e-4, span, time=body.time)])
    return result


NEAR = WireCurve(np.array([0.5, 0.0, 2.0]), np.array([0.0, 1.0, 0.0]))


@pytest.mark.parametrize("spans, more, extent", [
    (10 * [(-1.0, 1.0)] + [(-1.0, 1.8), (-1.0, 1.5), (-1.9, 1.0)], {}, (-1.0, 1.5)),
    (7 * [(-2.0, 2.0), (-2.0, 8.5)], {}, (-2.0, 2.0)),
    (6 * [(-1.0, 1.0), (-1.0, 5.0)], dict(wire=NEAR, begin=1.85, step=0.03), (-1.0, 1.0)),
    (10 * [(-2.0, 2.0)] + [(-1.5, 2.5), (-1.0, 3.0), (-0.5, 3.5)], dict(stop=9), (-2.0, 3.0))],
    ids=["seen twice", "within 8 m", "not almost along it", "by a turn in one place"])
def test_a_wire_is_as_long_as_it_was_seen_for_sure(spans, more, extent):
    (line,) = mapped(spans, **more).lines
    assert sorted((line.start[1], line.end[1])) == pytest.approx(extent, abs=0.03)


@pytest.mark.parametrize("attitude, published", [(0.04, True), (0.06, False)])
def test_a_wire_that_is_known_to_worse_than_15_cm_is_named_and_not_published(attitude, published):
    """3 m away, by what the vehicle's attitude is doubted by."""
    result = mapped(12 * [(-1.0, 1.0)], attitude=attitude)
    assert (len(result.lines) == 1) is published is not result.degenerate
    assert published or result.message == f"line 0: position uncertainty of {3.05 * attitude:.2f} m is too large"


@pytest.mark.parametrize("turn_deg, aside, same", [(2.0, 0.04, True), (4.0, 0.0, False), (0.0, 0.07, False)])
def test_two_wires_are_one_where_they_run_together_and_not_where_they_cross(turn_deg, aside, same):
    """The second one was seen over half a metre: however it is turned, it is near the first one there."""
    one, other = (SimpleNamespace(estimate=WireEstimate(wire, 1e-6 * np.eye(5), np.ones(4, bool), np.zeros(3), 0.01), extent=(-0.25, 0.25)) for wire in (
        ACROSS, WireCurve(ACROSS.point + [0.0, 0.0, aside], so3.exp(np.radians([0.0, 0.0, turn_deg])) @ ACROSS.direction)))
    assert _same_wire(one, other) is same


def test_motion_along_the_wires_is_called_degenerate(wires):
    _, renderer = wires
    result = Flight(renderer, 3).fly((0.0, -0.5, 2.2), (0.0, 0.5, 2.2), 12)
    assert result.degenerate and result.lines == ()
    assert "baseline ratio" in result.message and "move across" in result.message


@pytest.mark.parametrize("radius, counted", [(0.0, None), (0.03, 0)], ids=["width unknown", "width measured"])
def test_a_sighting_of_wires_in_line_counts_only_where_its_width_tells_which_it_is(radius, counted):
    """Two wires that coincide from where the camera is: the nearer one covers the other, and looks twice as wide."""
    rng = np.random.default_rng(8)
    near, far = WireCurve(np.array([2.0, 0.0, 2.0]), np.array([0.0, 1.0, 0.0])), \
        WireCurve(np.array([4.0, 0.0, 2.02]), np.array([0.0, 1.0, 0.0]))
    mapper = LineMapper(MapperConfig())
    for k in range(12):
        centre = np.array([0.0, 0.0, 1.0 + 0.08 * k])
        body = BodyState(0.1 * k, centre, np.array([0, 0, 0, 1.0]), np.zeros(3), np.zeros(3), np.eye(6) * 1e-6)
        mapper.update(0.1 * k, body, [observe(rng, w, centre, 2e-4, time=0.1 * k, radius=radius) for w in (near, far)])
    before = mapper.map(1.2)
    assert len(before.lines) == 2
    centre = np.array([0.0, 0.0, 2.0])
    body = BodyState(1.3, centre, np.array([0, 0, 0, 1.0]), np.zeros(3), np.zeros(3), np.eye(6) * 1e-6)
    after = mapper.update(1.3, body, [observe(rng, near, centre, 2e-4, time=1.3, radius=radius)])
    assert [a.observations - b.observations for a, b in zip(after.lines, before.lines, strict=True)] == [int(k == counted) for k in (0, 1)]


@pytest.mark.parametrize("height, meets", [(0.0, False), (0.03, True), (0.06, True), (0.2, False)],
                         ids=["hidden", "sticks out", "beside it", "apart"])
@pytest.mark.parametrize("sigma, width", [(1e-3, 0.03), (1e-3, 0.0)])
def test_the_width_of_a_wire_before_another_counts_only_where_it_is_its_own(height, meets, sigma, width):
    """From 1 m, the other one 1 m behind and some centimetres higher: its image is half as wide."""
    along, seen_from = np.array([0.0, 1.0, 0.0]), np.zeros(3)
    near, far = WireCurve(np.array([1.0, 0.0, 0.0]), along), WireCurve(np.array([2.0, 0.0, height]), along)
    tracks = [SimpleNamespace(estimate=WireEstimate(w, sigma**2 * np.eye(5), np.ones(4, bool), np.zeros(3), 0.03), extent=(-2.0, 2.0))
              for w in (near, far)]
    assert meets_another(tracks, tracks[0], observe(np.random.default_rng(0), near, seen_from, radius=width)) is (meets and width > 0.0)


def test_the_doubt_of_the_cameras_mount_is_counted_once():
    """The fit's covariance has it; what the vehicle's attitude is doubted by comes on top."""
    rng, attitude = np.random.default_rng(11), np.radians(0.5)
    for sigma in (1e-6, attitude):
        mapper = LineMapper(MapperConfig())
        for k in range(16):
            centre = np.array([0.0, 0.0, 1.8 + 0.05 * k])
            body = BodyState(0.1 * k, centre, np.array([0, 0, 0, 1.0]), np.zeros(3), np.zeros(3), np.eye(6) * sigma**2)
            result = mapper.update(body.time, body, [observe(rng, WIRE, centre, 2e-4, time=body.time)])
        line = result.lines[0]
        estimate, middle = mapper._tracks[0].estimate, line.segment.centre
        fit = estimate.point_covariance((middle - estimate.curve.point) @ estimate.curve.direction)
        lever = so3.hat(middle - centre)
        np.testing.assert_allclose(line.covariance, fit + sigma**2 * lever @ lever.T, atol=1e-5)  # once more were 2e-4
        assert line.direction_sigma**2 == pytest.approx(np.linalg.eigvalsh(estimate.covariance[2:4, 2:4])[-1] + sigma**2, rel=1e-6)


def test_a_wire_that_was_seen_from_one_place_only_says_so():
    rng, mapper = np.random.default_rng(9), LineMapper(MapperConfig())
    body = BodyState(0.0, np.array([0, 0, 2.0]), np.array([0, 0, 0, 1.0]), np.zeros(3), np.zeros(3))
    for k in range(5):
        result = mapper.update(0.1 * k, body, [observe(rng, WIRE, np.array([0, 0, 2.0]), time=0.1 * k)])
    assert result.degenerate and result.message == "line 0: seen from one place only: move across the wire"


def test_false_sightings_are_forgotten():
    rng = np.random.default_rng(9)
    mapper = LineMapper(MapperConfig())
    body = BodyState(0.0, np.array([0, 0, 2.0]), np.array([0, 0, 0, 1.0]), np.zeros(3), np.zeros(3))
    mapper.update(0.0, body, [observe(rng, WIRE, np.array([0, 0, 2.0]))])
    assert len(mapper._tracks) == 1
    mapper.update(1.9, body, [])
    assert len(mapper._tracks) == 1
    mapper.update(2.1, body, [])
    assert mapper._tracks == []


def test_a_wire_of_two_sightings_is_forgotten_though_it_was_triangulated():
    mapper, wire = LineMapper(MapperConfig()), WireCurve(np.array([3.0, 0.0, 2.5]), np.array([0.0, 1.0, 0.0]))
    body = BodyState(0.0, np.array([0, 0, 2.0]), np.array([0, 0, 0, 1.0]), np.zeros(3), np.zeros(3))
    for k, height in enumerate((1.87, 2.12)):
        mapper.update(0.1 * k, body, [observe(np.random.default_rng(9), wire, np.array([0.0, 0.0, height]), time=0.1 * k)])
    assert [track.estimate is not None for track in mapper._tracks] == [True]
    mapper.update(2.2, body, [])
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
            lines = mapper.update(time, body, [observe(rng, wire, true, 2e-4, time=time, believed=believed)]).lines
        assert len(lines) == 1
        errors[drift] = np.linalg.norm((lines[0].segment.centre - [3.0, 0.0, 2.5] - believed + true)[[0, 2]])
    assert errors[0.01] < 0.3 * errors[0.0] and errors[0.01] < 0.025, errors


@pytest.mark.parametrize("drop", [0.15, 0.25])
def test_a_wire_that_is_seen_anew_beside_its_old_place_replaces_it(drop):
    """The odometry was corrected by more than sightings are associated over: one wire must not become two obstacles. The larger
    correction is a jump, with which the wire moves."""
    rng, mapper, poses = np.random.default_rng(11), LineMapper(MapperConfig()), PoseBuffer()
    wire, jump = WireCurve(np.array([3.0, 0.0, 2.5]), np.array([0.0, 1.0, 0.0])), np.array([0.0, 0.0, -drop])
    for k in range(80):
        time, true = 0.1 * k, np.array([0.0, 0.0, 1.6 + 0.8 * abs((k / 15) % 2 - 1)])
        believed = true + (jump if k >= 30 else 0.0)
        poses.add(BodyState(time, believed, np.array([0, 0, 0, 1.0]), np.zeros(3), np.zeros(3), np.eye(6) * 1e-6))
        lines = mapper.update(time, poses.at(time), [observe(rng, wire, true, 2e-4, time=time, believed=believed)]).lines
    assert len(lines) == 1
    assert np.linalg.norm((lines[0].segment.centre - [3.0, 0.0, 2.5] - jump)[[0, 2]]) < 0.03


def test_a_wire_out_of_view_stays_beside_its_neighbour_that_is_seen():
    """Bundles hang 25 cm apart; seen together before, they are two wires."""
    rng, mapper = np.random.default_rng(14), LineMapper(MapperConfig())
    upper, lower = (WireCurve(np.array([3.0, 0.0, z]), np.array([0.0, 1.0, 0.0])) for z in (2.5, 2.25))
    for k in range(60):
        time, true = 0.1 * k, np.array([0.0, 0.0, 1.6 + 0.8 * abs((k / 15) % 2 - 1)])
        body = BodyState(time, true, np.array([0, 0, 0, 1.0]), np.zeros(3), np.zeros(3), np.eye(6) * 1e-6)
        seen = [observe(rng, wire, true, 2e-4, time=time) for wire in ((upper, lower) if k < 40 else (upper,))]
        lines = mapper.update(time, body, seen).lines
        assert k < 35 or len(lines) == 2, (k, lines)


def test_two_that_turn_out_to_be_one_were_last_seen_when_either_was():
    maps, wire = [], WireCurve(np.array([3.0, 0.0, 2.5]), np.array([0.0, 1.0, 0.0]))
    for begin in (0.0, 10.0):
        rng, mapper = np.random.default_rng(16), LineMapper(MapperConfig())
        for k in range(30):
            time, true = begin + 0.1 * k, np.array([0.0, 0.0, 1.6 + 0.8 * abs((k / 15) % 2 - 1)])
            body = BodyState(time, true, np.array([0, 0, 0, 1.0]), np.zeros(3), np.zeros(3), np.eye(6) * 1e-6)
            mapper.update(time, body, [observe(rng, wire, true, 2e-4, time=time)])
        maps.append(mapper)
    older, newer = maps
    older._tracks += newer._tracks
    older._merge(set(older._tracks))
    assert [track.last.time for track in older._tracks] == [newer._tracks[0].last.time]


def test_pieces_of_a_wire_keep_numbers_of_their_own_after_many_wires():
    rng, mapper = np.random.default_rng(15), LineMapper(MapperConfig())
    sagging, straight = WireCurve(np.array([3.0, 0.0, 2.5]), np.array([0.0, 1.0, 0.0]), 0.05), WireCurve(np.array([3.0, 0.0, 4.5]), np.array([0.0, 1.0, 0.0]))
    for k in range(60):
        if k == 20:
            mapper._next_id = 100  # what false sightings use up in a minute
        time, true = 0.1 * k, np.array([0.0, 0.0, 1.6 + 0.8 * abs((k / 15) % 2 - 1)])
        body = BodyState(time, true, np.array([0, 0, 0, 1.0]), np.zeros(3), np.zeros(3), np.eye(6) * 1e-6)
        lines = mapper.update(time, body, [observe(rng, wire, true, 2e-4, time=time) for wire in ((sagging,) if k < 20 else (sagging, straight))]).lines
    assert len(lines) >= 3 and len({line.id for line in lines}) == len(lines), [line.id for line in lines]


def test_ids_of_wires_begin_anew_before_they_meet_those_of_pieces():
    """After a million wires; those that the map still has are left out."""
    mapper, rng = LineMapper(MapperConfig()), np.random.default_rng(16)
    body = BodyState(0.0, np.zeros(3), np.array([0, 0, 0, 1.0]), np.zeros(3), np.zeros(3), np.eye(6) * 1e-6)
    for number, height in enumerate((1.0, 2.0, 3.0, 4.0)):
        if number == 2:
            mapper._next_id = PIECE_IDS - 1
        wire = WireCurve(np.array([3.0, 0.0, height]), np.array([0.0, 1.0, 0.0]))
        mapper.update(0.1 * number, replace(body, time=0.1 * number), [observe(rng, wire, np.zeros(3), time=0.1 * number)])
    assert [track.id for track in mapper._tracks] == [0, 1, PIECE_IDS - 1, 2]


def test_between_two_states_the_correction_is_between_theirs():
    poses, level = PoseBuffer(), np.array([0.0, 0.0, 0.0, 1.0])
    for time, x in ((0.0, 0.0), (0.002, 0.006), (0.004, 0.062)):  # 5 cm of the last step are no motion
        poses.add(BodyState(time, np.array([x, 0.0, 2.0]), level, np.array([3.0, 0.0, 0.0]), np.zeros(3), np.eye(6) * 1e-6))
    for time in np.linspace(0.0, 0.004, 9):
        state = poses.at(float(time))
        assert state.p_WB[0] - state.corrected[0] == pytest.approx(3.0 * time, abs=1e-9)


@pytest.mark.parametrize("step, interval, counted", [(0.16, 0.002, True), (0.14, 0.002, False), (0.16, 0.29, True), (0.16, 0.31, False)])
def test_a_jump_is_a_correction_at_any_speed_but_not_across_a_pause(step, interval, counted):
    poses, level, velocity = PoseBuffer(), np.array([0.0, 0.0, 0.0, 1.0]), np.array([0.1, 0.0, 0.0])
    jump = step * np.array([0.6, 0.0, -0.8])
    for time in (1.0, 1.002):
        poses.add(BodyState(time, velocity * time, level, velocity, np.zeros(3), np.eye(6) * 1e-6))
    for later in (0.0, 0.002):
        time = 1.002 + interval + later
        poses.add(BodyState(time, velocity * time + jump, level, velocity, np.zeros(3), np.eye(6) * 1e-6))
        np.testing.assert_allclose(poses.at(time).corrected, counted * jump, atol=1e-12)


@pytest.mark.parametrize("speed, interval, share", [(0.9, 0.02, 0.0), (1.5, 0.02, 0.5), (2.5, 0.02, 1.0), (2.5, 0.06, 0.0)])
def test_a_small_correction_counts_the_more_the_faster_it_flies_and_not_across_a_gap(speed, interval, share):
    """By 8 cm, less than what is a jump."""
    poses, level, velocity = PoseBuffer(), np.array([0.0, 0.0, 0.0, 1.0]), np.array([speed, 0.0, 0.0])
    for time, correction in ((1.0, 0.0), (1.0 + interval, 0.08)):
        poses.add(BodyState(time, velocity * time + (0.0, correction, 0.0), level, velocity, np.zeros(3), np.eye(6) * 1e-6))
    np.testing.assert_allclose(poses.at(poses.newest).corrected, [0.0, 0.08 * share, 0.0], atol=1e-12)


@pytest.mark.parametrize("rate, steps", [(500, [0.016] * 25), (150, [0.13] * 3), (30, [0.4 * 0.4 * 0.6**n for n in range(9)]),
                                         (30, [0.13] * 2 + [-0.04] * 2), (30, [0.07] * 3 + [-0.01] * 6)])
def test_a_jump_that_several_samples_have_counts_in_full_and_a_drift_does_not(rate, steps):
    poses, level, drift = PoseBuffer(), np.array([0.0, 0.0, 0.0, 1.0]), np.array([0.05, 0.0, 0.0])  # of the position alone [m/s]
    believed = np.array([0.0, 0.0, 2.0])
    for k, step in enumerate([0.0] * (2 * rate) + steps + [0.0] * rate):
        believed = believed + drift / rate + (0.0, 0.0, -step)
        poses.add(BodyState(k / rate, believed, level, np.zeros(3), np.zeros(3), np.eye(6) * 1e-6))
        if k == 2 * rate:
            before = poses.at((k - 1) / rate).corrected
    np.testing.assert_array_equal(before, np.zeros(3))
    np.testing.assert_allclose(poses.at(poses.newest).corrected, [0.0, 0.0, -sum(steps)], atol=0.03)


def test_nothing_is_mapped_from_a_pose_that_is_hardly_known():
    poses, level = PoseBuffer(), np.array([0.0, 0.0, 0.0, 1.0])
    for time, sigma in ((1.0, 0.1), (1.02, 0.1), (1.04, 3.0), (1.06, 3.0)):
        poses.add(BodyState(time, np.array([time, 0.0, 2.0]), level, np.zeros(3), np.zeros(3), np.eye(6) * sigma**2))
    assert mapping_pose(poses, 1.01, 2.0).p_WB[0] == pytest.approx(1.01)
    with pytest.raises(StampError, match="position uncertainty 3.00 m exceeds"):
        mapping_pose(poses, 1.05, 2.0)
    with pytest.raises(StampError, match="older"):
        mapping_pose(poses, 0.5, 2.0)


@pytest.mark.parametrize("speed, share", [(0.0, 0.0), (3.0, 1.0)])
def test_wires_move_along_with_what_the_odometry_corrects_its_position_by(speed, share):
    """At speed the odometry finds that it is 7 cm elsewhere: so is the wire, seen or not. In a hover the position is believed."""
    wire, rng, mapper, poses = WireCurve(np.array([3.0, 0.0, 2.5]), np.array([0.0, 1.0, 0.0])), np.random.default_rng(2), LineMapper(), PoseBuffer()
    level, correction, maps = np.array([0.0, 0.0, 0.0, 1.0]), np.array([-0.03, 0.0, 0.065]), []
    for k in range(1501):
        time = 0.002 * k
        away = max(time - 2.2, 0.0)
        true = np.array([-speed * away, 0.0, 1.8 + 0.4 * min(time, 2.0)])
        velocity = np.array([-speed * (away > 0.0), 0.0, 0.4 * (time < 2.0)])
        poses.add(BodyState(time, true + np.clip(away / 0.5, 0.0, 1.0) * correction, level, velocity, np.zeros(3)))
        if k % 50 == 0:
            body = poses.at(time)
            seen = [observe(rng, wire, true, 1e-4, time=time, believed=body.p_WB)] if time < 2.15 else []
            maps.append(mapper.update(time, body, seen).lines)
    before, after = (next(line.segment for line in lines) for lines in (maps[21], maps[-1]))
    np.testing.assert_allclose(poses.at(3.0).corrected, share * correction, atol=5e-3)
    np.testing.assert_allclose(after.centre - before.centre, poses.at(3.0).corrected, atol=1e-3)
    assert before.distance(wire.point) < 0.02


@pytest.mark.parametrize("sag", [0.039, 0.155])
def test_the_chords_of_a_sagging_wire_stay_within_two_centimetres_of_it(sag):
    rng, wire, mapper = np.random.default_rng(1), WireCurve(WIRE.point, WIRE.direction, sag / 2.0), LineMapper()  # over 4 m
    for k in range(12):
        p = np.array([0.0, 0.0, 1.6 + 0.1 * k])
        body = BodyState(0.1 * k, p, np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3), np.zeros(3), 1e-8 * np.eye(6))
        lines = mapper.update(body.time, body, [observe(rng, wire, p, time=body.time, radius=0.03)]).lines
    points = wire.at(np.linspace(-1.99, 1.99, 300))
    assert lines and np.max(np.min([line.segment.distance(points) for line in lines], axis=0)) < 0.021
