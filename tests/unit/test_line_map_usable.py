"""The map of wires stays usable: whatever is seen, where the odometry jumps, and however many wires there are."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.wires import MOUNT, observe
from perch_core.values import limits
from perch_perception.line_mapping import LineDetectionConfig, LineMapper, WireCurve, WireEstimate, detect_lines, place
from perch_perception.line_mapping import mapper as mapper_module
from perch_perception.pose_buffer import BodyState, PoseBuffer


@settings(max_examples=25, deadline=None)
@given(radius=st.just(0.0) | st.floats(0.001, 3.0), distance=st.floats(0.5, 40.0), seed=st.integers(0, 9))
def test_whatever_is_seen_receivers_accept_the_map(radius, distance, seed):
    """A line that they would refuse is left out, with the reason, and does not cost them the others."""
    rng, mapper = np.random.default_rng(seed), LineMapper()
    near, other = (WireCurve(np.array([x, 0.0, z]), np.array([0.0, 1.0, 0.0])) for x, z in ((3.0, 2.5), (distance, 4.0)))
    for k in range(16):
        centre = np.array([0.0, 0.0, 1.0 + 0.15 * k])
        body = BodyState(0.1 * k, centre, np.array([0, 0, 0, 1.0]), np.zeros(3), np.zeros(3), np.eye(6) * 1e-6)
        seen = [observe(rng, near, centre, 2e-4, time=body.time, radius=0.02),
                observe(rng, other, centre, 2e-4, time=body.time, radius=min(radius, 0.9 * distance))]
        result = mapper.update(body.time, body, seen)
        assert limits.problem(result) == ""
    assert len(result.lines) > 0


def test_a_red_door_is_left_out_with_the_reason():
    """4.4 x 2.6 m from 7 m, below a wire: as a wire its radius is 1.3 m, which every receiver refuses, with the whole map."""
    camera, mapper = MOUNT.camera, LineMapper()
    door, wire = (np.array([[x, y, z] for z, side in ((low, 1), (high, -1)) for y in side * np.linspace(-half, half, 30)])
                  for x, half, low, high in ((7.0, 2.2, 0.6, 3.2), (3.0, 1.8, 3.4, 3.44)))
    for k in range(40):
        p = np.array([0.0, 0.3 * np.sin(k / 7), 1.6 + 0.8 * abs((k / 15) % 2 - 1)])
        p_WC, R_WC = MOUNT.pose(p, np.eye(3))
        image = np.full((camera.height, camera.width, 3), 110, np.uint8)
        for outline in (door, wire):
            pixels = camera.project((outline - p_WC) @ R_WC)[0]
            cv2.fillPoly(image, [np.rint(16.0 * pixels).astype(np.int32)], (180, 40, 40), cv2.LINE_AA, 4)
        body = BodyState(0.1 * k, p, np.array([0, 0, 0, 1.0]), np.zeros(3), np.zeros(3), np.eye(6) * 1e-6)
        seen = detect_lines(cv2.GaussianBlur(image, (0, 0), 0.8), camera, LineDetectionConfig())
        result = mapper.update(body.time, body, [place(one, body, MOUNT) for one in seen])
    assert limits.problem(result) == "" and not result.degenerate
    assert len(result.lines) == 1 and result.lines[0].segment.distance(np.array([3.0, 0.0, 3.42])) < 0.15
    assert result.message.startswith("line 1: radius: 1.3")


def test_wires_that_were_passed_cost_little_and_are_not_missed(monkeypatch):
    """300 wires, four of them in view: these are compared with the others, not all with all, and the far ones are forgotten."""
    rng, mapper, compared = np.random.default_rng(1), LineMapper(), []
    wires = [WireCurve(np.array([3.0 + 0.5 * i, 0.0, 2.5 + 0.6 * i]), np.array([0.0, 1.0, 0.0])) for i in range(4)]

    def image(k):
        centre = np.array([0.0, 0.0, 1.6 + 0.1 * k])
        body = BodyState(0.1 * k, centre, np.array([0, 0, 0, 1.0]), np.array([0.0, 0.0, 1.0]), np.zeros(3), np.eye(6) * 1e-4)
        return mapper.update(body.time, body, [observe(rng, wire, centre, 2e-4, time=body.time) for wire in wires])

    for k in range(8):
        image(k)
    known = mapper._tracks[0]
    for k in range(296):
        away = np.array([-8.0 - 2.0 * k, 0.0, 0.0])
        last = replace(known.last, time=-10.0, p_WC=known.last.p_WC + away)
        estimate = replace(known.estimate, curve=replace(known.estimate.curve, point=known.estimate.curve.point + away))
        mapper._tracks.append(mapper_module._Track(100 + k, [last], last, 8, estimate, known.extent))
    monkeypatch.setattr(mapper_module, "_is_adjacent", lambda a, b, distance, original=mapper_module._is_adjacent:
                        compared.append((a, b)) or original(a, b, distance))
    result = image(8)
    assert len(compared) <= 2 * 4 * 300, "to merge and to supersede"
    assert len(mapper._tracks) == 4 + 23, "23 are within 50 m"
    assert not result.degenerate and [line.id for line in result.lines[:4]] == [0, 1, 2, 3]


def test_more_lines_than_receivers_accept_are_not_published():
    mapper = LineMapper()
    body = BodyState(0.0, np.zeros(3), np.array([0, 0, 0, 1.0]), np.zeros(3), np.zeros(3), np.eye(6) * 1e-6)
    mapper.update(0.0, body, [])
    along = np.array([0.0, 1.0, 0.0])
    for k in range(510):
        one = observe(np.random.default_rng(0), WireCurve(np.array([3.0 + 0.05 * k, 0.0, 2.0]), along), np.zeros(3))
        estimate = WireEstimate(WireCurve(np.array([3.0 + 0.05 * k, 0.0, 2.0]), along), 1e-6 * np.eye(5), np.ones(4, bool), np.zeros(3), 0.01)
        mapper._tracks.append(mapper_module._Track(k, [one], one, 9, estimate, (-2.0, 2.0)))
    result = mapper.map(0.1)
    assert limits.problem(result) == "" and [line.id for line in result.lines] == list(range(500))
    assert "nearest 500" in result.message


@pytest.mark.parametrize("jump", [(0.0, 0.0, -0.35), (0.35, 0.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.6, 0.3, 0.2)])
def test_the_map_jumps_with_the_odometry(jump):
    """In a hover: neither a ghost at the wire's old place nor a time without the wire, whether or not it is in view."""
    rng, mapper, poses = np.random.default_rng(11), LineMapper(), PoseBuffer()
    wires = [WireCurve(np.array([3.0, 0.0, z]), np.array([0.0, 1.0, 0.0])) for z in (2.5, 3.5)]
    for k in range(80):
        time, height = 0.1 * k, 1.6 + 0.8 * abs((k / 15) % 2 - 1)
        true, speed = np.array([0.0, 0.0, height]), -0.53 if k % 30 < 15 else 0.53
        believed = true + (np.array(jump) if k >= 40 else 0.0)
        poses.add(BodyState(time, believed, np.array([0, 0, 0, 1.0]), np.array([0.0, 0.0, speed]), np.zeros(3), np.eye(6) * 1e-6))
        in_view = wires if k < 35 else wires[:1]
        seen = [observe(rng, wire, true, 2e-4, time=time, believed=believed) for wire in in_view]
        lines = mapper.update(time, poses.at(time), seen).lines
        if k > 30:
            assert [line.id for line in lines] == [0, 1]
            for line, wire in zip(lines, wires):
                assert line.segment.distance(wire.point + believed - true) < 0.05
