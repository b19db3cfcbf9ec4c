"""Re-integration, certificates, poses, guesses and the refusal of bad requests."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from perch_core import so3
from perch_core.components import components, stack
from perch_core.errors import PlanningRefusal
from perch_core.lines import Segment
from perch_core.rotor_model import RotorModel, derivative, hover_state
from perch_core.values import PerchGoal, PowerlinePlanRequest, limits
from perch_core.vehicle import load_vehicle
from perch_planner.powerline import guess
from perch_planner.powerline.certificate import certify, certify_end
from perch_planner.powerline.flight import simulate
from perch_planner.powerline.picture import SideView
from perch_planner.powerline.request import PerchPose, PowerlineRequest
from perch_planner.powerline.service import check_request as check_service_request
from perch_planner.powerline.settings import PowerlineSettings
from perch_planner.powerline.validation import check_request

VEHICLE = load_vehicle("rpg")
MODEL = RotorModel.of(VEHICLE)
LEVEL = np.array([0.0, 0, 0, 1])
LINE = Segment([4.0, 0, 4.2], [0, 1, 0], 2.0, 0.03, 0)
OTHER = Segment([5.0, 0, 3.7], [0, 1, 0], 2.0, 0.03, 1)


def request(**changes) -> PowerlineRequest:
    start = hover_state(MODEL, np.array([0.0, 0, 4.3]), LEVEL)
    pose = PerchPose.on_line(LINE, LINE.centre, np.radians(80), VEHICLE.perch_offset, start[:3])
    return dataclasses.replace(PowerlineRequest(start, (LINE, OTHER), 0, pose), **changes)


def refusal(**changes) -> PlanningRefusal:
    with pytest.raises(PlanningRefusal) as caught:
        check_request(request(**changes), VEHICLE, PowerlineSettings())
    return caught.value


def test_the_gripper_is_where_plans_bring_it() -> None:
    """A given pose may be as far from where a plan would end on one side as on the other."""
    planned = request().perch
    at_plan = PerchPose.on_line(LINE, LINE.centre, np.radians(80), VEHICLE.wire_offset, np.array([0.0, 0, 4.3]))
    for off in (-0.045, 0.045):
        check_request(request(perch=dataclasses.replace(planned, p_WB=at_plan.p_WB + off * planned.s3_W)), VEHICLE, PowerlineSettings())
    for off in (-0.055, 0.055):
        given = dataclasses.replace(planned, p_WB=at_plan.p_WB + off * planned.s3_W)
        assert refusal(perch=given).constraint in ("gripper", "clearance [P:eq14j]")


def test_flight_agrees_with_an_adaptive_integrator() -> None:
    rng = np.random.default_rng(0)
    start, rates, T = hover_state(MODEL, np.zeros(3), LEVEL), rng.uniform(-6, 6, (5, 4)), 0.5
    times, states, inputs = simulate(MODEL, start, rates, T)
    x = start
    for row in rates:
        x = solve_ivp(lambda _, y: stack(derivative(MODEL, components(y), components(row))), (0, T / 5), x,
                      rtol=1e-11, atol=1e-12).y[:, -1]
    np.testing.assert_allclose(states[-1], x, atol=1e-7)
    assert times[-1] == pytest.approx(T) and np.diff(times).max() <= 1e-3 + 1e-12
    assert states.shape == (len(times), 17) and inputs.shape == (len(times), 4)


def test_certificates_find_what_is_violated_and_where() -> None:
    times = np.linspace(0, 1, 101)
    states = np.tile(hover_state(MODEL, np.array([0.0, 0, 2.0]), LEVEL), (101, 1))
    states[:, 2] = 2.0 - 1.5 * np.sin(np.pi * times)  # down to 0.5 m
    states[70, 12] = 8.0
    bounds = {b.quantity: b for b in certify(VEHICLE, times, states, np.zeros((101, 4)), [LINE], 0.8, 7.0)}
    assert not bounds["height"].holds and bounds["height"].margin == pytest.approx(-0.3)
    assert bounds["height"].time_of_minimum == pytest.approx(0.5)
    assert not bounds["body_rate"].holds and bounds["body_rate"].time_of_maximum == pytest.approx(0.7)
    assert bounds["thrust"].holds and bounds["clearance"].holds and bounds["thrust_rate"].holds


def test_clearance_certificate_counts_every_line() -> None:
    times, states = np.array([0.0, 1.0]), np.tile(hover_state(MODEL, np.array([5.0, 0, 3.75]), LEVEL), (2, 1))
    alone, both = (certify(VEHICLE, times, states, np.zeros((2, 4)), some, 0.8, 7.0)[0] for some in ([LINE], [LINE, OTHER]))
    assert alone.holds and not both.holds


def test_end_errors_are_measured_against_the_pose() -> None:
    pose = PerchPose(np.array([1.0, 2, 3]), np.array([1.0, 0, 0]))
    state = hover_state(MODEL, np.array([1.0, 2, 3.002]), so3.quat_exp([0, np.radians(89), 0]))
    state[7] = 0.01
    errors = {b.quantity: b.maximum for b in certify_end(np.array([1.0]), state[None], pose, 0.001, 0.1, 0.02)}
    assert errors["end_position"] == pytest.approx(0.002)
    assert errors["end_tilt"] == pytest.approx(1.0)
    assert errors["end_speed"] == pytest.approx(0.01)


@pytest.mark.parametrize("pitch", [0.0, 20.0, 80.0, 90.0, 180.0])
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_pose_on_a_line_leans_to_the_side_of_the_start(pitch: float, side: float) -> None:
    line = Segment([1.0, 2, 5], [0.3, 1, 0.1], 3.0, 0.03)
    start = line.centre + side * np.array([4.0, 0, -1])
    pose = PerchPose.on_line(line, line.centre, np.radians(pitch), 0.15, start)
    assert line.distance(pose.p_WB) == pytest.approx(0.15)
    assert pose.s3_W @ line.direction == pytest.approx(0, abs=1e-12)
    up = np.array([0, 0, 1.0]) - line.direction[2] * line.direction
    assert np.degrees(so3.angle_between(pose.s3_W, up)) == pytest.approx(pitch, abs=1e-6)
    if 0 < pitch < 180:
        assert pose.s3_W[:2] @ (start - line.centre)[:2] > 0


@pytest.mark.parametrize("pitch", [3.1415927, 3.141593, float(np.float32(np.pi))])
def test_a_pitch_of_pi_that_was_rounded_is_planned_as_the_mission_takes_it(pitch: float) -> None:
    assert not limits.problem(PerchGoal(mode=1, perch_pitch=pitch, inclination_hint=pitch))
    check_service_request(PowerlinePlanRequest(start=0, p=np.array([0.0, 0, 4.3]), q=LEVEL, perch_pitch=pitch))
    pose = PerchPose.on_line(LINE, LINE.centre, pitch, VEHICLE.wire_offset, np.array([0.0, 0, 4.3]))
    np.testing.assert_allclose(pose.s3_W, [0, 0, -1], atol=1e-6)


@pytest.mark.parametrize("s3", [[0.0, 0, 1], [1.0, 0, 0], [0, 0, -1.0], [0.6, 0, -0.8]])
def test_perch_guess_joins_start_and_pose(s3: list[float]) -> None:
    start = hover_state(MODEL, np.array([0.0, 0, 4]), so3.quat_exp([0, 0, 0.3]))
    states, inputs = guess.perch_guess(MODEL, start, np.array([4.0, 0, 4.2]), np.array(s3), 0.85, 30)
    np.testing.assert_array_equal(states[0, :17], start)
    np.testing.assert_allclose(states[-1, :3], [4.0, 0, 4.2])
    np.testing.assert_allclose(so3.quat_to_matrix(states[-1, 3:7])[:, 2], s3, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(states[:, 3:7], axis=1), 1)
    b3 = so3.quat_to_matrix(states[:, 3:7])[:, :, 2]
    if s3[0] > 0:
        assert b3[:, 0].min() > -1e-9
    if s3[2] == -1.0:  # braking: it turns over backwards, away from the line
        assert b3[20, 0] < -0.1


def test_a_guess_upside_down_leans_back_though_the_wire_is_inclined() -> None:
    """The shortest way to a pose on a wire inclined by 1 deg is sideways, along the wire."""
    start = hover_state(MODEL, np.array([0.0, 0, 4]), LEVEL)
    s3 = np.array([0.0, np.sin(np.radians(1.1)), -np.cos(np.radians(1.1))])
    states, _ = guess.perch_guess(MODEL, start, np.array([4.0, 0, 4.2]), s3, 0.85, 30)
    b3 = so3.quat_to_matrix(states[:, 3:7])[:, :, 2]
    np.testing.assert_allclose(b3[-1], s3, atol=1e-9)
    assert b3[:, 0].min() < -0.95
    assert np.abs(b3[:, 1]).max() < 0.02


@pytest.mark.parametrize("tilt_deg", [140, 151, 165, 179, 180])
def test_the_guess_of_a_recovery_to_where_it_begins_ends_upright(tilt_deg: float) -> None:
    """Ways out of a perch upside down: no direction of the way says through which side to turn."""
    for side in ([1.0, 0, 0], [0, 1.0, 0], [-0.6, 0.8, 0]):
        start = hover_state(MODEL, np.array([0.0, 0, 4]), so3.quat_exp(np.radians(tilt_deg) * np.array(side)))
        states, _ = guess.recovery_guess(MODEL, start, start[:3], 0.85, 30)
        np.testing.assert_allclose(so3.quat_to_matrix(states[-1, 3:7])[:, 2], [0.0, 0.0, 1.0], atol=1e-9)


def test_guesses_turn_as_their_body_rates_say() -> None:
    start = hover_state(MODEL, np.array([0.0, 0, 4]), so3.quat_exp([0, 0, 0.3]))
    perch, _ = guess.perch_guess(MODEL, start, np.array([4.0, 0, 4.2]), np.array([-0.8, 0, 0.6]), 0.85, 60, b3_turn=0.5)
    leaving, _ = guess.recovery_guess(MODEL, perch[-1, :17], np.array([0.0, 0, 4]), 0.85, 60)
    for states in (perch, leaving):
        h = states[0, 17] / 60
        turned = so3.quat_multiply(states[1:-2, 3:7], so3.quat_exp(h * 0.5 * (states[1:-2, 10:13] + states[2:-1, 10:13])))
        assert so3.angle_between(so3.quat_to_matrix(turned)[:, :, 0], so3.quat_to_matrix(states[2:-1, 3:7])[:, :, 0]).max() < 0.03
        assert np.linalg.norm(states[:, 10:13], axis=1).max() > 1.0


@pytest.mark.parametrize("yaw", [-0.2, 0.2])
def test_a_guess_with_the_line_in_view_turns_to_the_side_it_looks_to(yaw: float) -> None:
    q_BC = so3.quat_from_matrix(VEHICLE.mounts["front"].R_BC)
    for sense in (-1.0, 1.0):
        side = guess.side_turn(so3.quat_exp([0, 0, yaw]), q_BC, np.array([0.0, sense, 0.1]), np.array([4.0, 0.5, 0]))
        assert np.sign(side) == np.sign(yaw)


@pytest.mark.parametrize(("changes", "code", "words"), [
    (dict(start=np.full(17, np.nan)), "bad_input", "start state"),
    (dict(start=np.zeros(16)), "bad_input", "shape"),
    (dict(perch=None), "bad_input", "no perch pose"),
    (dict(lines=()), "empty_map", "not in the map"),
    (dict(target_line=9), "empty_map", "target line 9"),
    (dict(lines=(LINE, Segment([4.0, 0, 4.2], [1, 0, 0], 2.0, 0.03, 5))), "bad_input", "lines 0 and 5 cross"),
    (dict(lines=(LINE, Segment([9.0, 0, 4.2], [0, 1, 0], 2.0, 0.03, 0))), "bad_input", "same id"),
    (dict(recovery_only=True, lines=(LINE, Segment([9.0, 0, 4.2], [0, 1, 0], 2.0, 0.03, 0))), "bad_input", "same id"),
    (dict(start=hover_state(MODEL, np.array([0.0, 0, 0.5]), LEVEL)), "start_invalid", "0.500 m is below height_min 0.8 m"),
    (dict(start=hover_state(MODEL, np.array([4.0, 0, 4.3]), LEVEL)), "start_invalid", "line 0 is nearer than the body"),
    (dict(start=hover_state(MODEL, np.array([0.0, 0, 4.3]), np.array([0, 0, 1.0, 0]))), "bad_input", "behind the vehicle"),
    (dict(perch=PerchPose(LINE.centre + [0, 0, 0.05], np.array([0, 0, 1.0]))), "perch_in_collision", "cuts line 0"),
    (dict(perch=PerchPose(OTHER.centre + [0, 0, 0.15], np.array([0, 0, 1.0]))), "bad_input", "off line 0"),
    (dict(perch=PerchPose(np.array([4.0, 0, 0.5]), np.array([0, 0, 1.0]))), "infeasible", "below height_min"),
])
def test_bad_requests_name_their_cause(changes: dict, code: str, words: str) -> None:
    error = refusal(**changes)
    assert error.code == code and words in str(error), str(error)


def test_neighbouring_pieces_of_one_cable_do_not_cross() -> None:
    pieces = (LINE, Segment.between([4.0, 2.0, 4.2], [4.0, 6.0, 4.35], 0.03, 7))
    check_request(request(lines=pieces), VEHICLE, PowerlineSettings())


def test_two_estimates_of_one_cable_do_not_cross() -> None:
    again = Segment([4.02, 0.5, 4.18], [0.02, 1, 0.01], 2.0, 0.03, 7)
    pose = PerchPose.on_line(LINE, LINE.centre, np.radians(80), 0.18, np.array([0.0, 0, 4.3]))
    check_request(request(lines=(LINE, OTHER, again), perch=pose), VEHICLE, PowerlineSettings())


def test_fast_turning_and_overdriven_starts_are_refused() -> None:
    fast, overdriven = request().start.copy(), request().start.copy()
    fast[11], overdriven[13] = 9.0, 12.0
    assert "9.00 rad/s" in str(refusal(start=fast))
    assert "12.00 N" in str(refusal(start=overdriven))


@pytest.mark.parametrize("start", [[0.0, 0.0, 4.0], [4.0, 0.0, 7.0]])
def test_a_perch_on_a_vertical_wire_is_drawn_from_the_side(start: list[float]) -> None:
    view = SideView(Segment([4.0, 0.0, 4.0], [0.0, 0.0, 1.0], 2.0, 0.03), np.array(start))
    outline = view.body(hover_state(MODEL, np.array([3.8, 0.0, 4.0]), LEVEL), VEHICLE.body_radii)
    np.testing.assert_allclose(np.ptp(outline, axis=0), 2.0 * np.array(VEHICLE.body_radii)[[0, 2]], rtol=0.01)
    np.testing.assert_allclose(view(np.array([4.0, 0.0, 6.0])), [4.0 - start[0], 6.0])
