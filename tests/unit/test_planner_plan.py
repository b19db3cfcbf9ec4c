"""Whole plans: any inclination, starts in motion, moving pads, all options; each re-checked by the independent verifier."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
from perch_core.errors import ConfigError
from perch_core.flatness import flat_to_state
from perch_core.surface import PerchSurface
from perch_core.vehicle import GRAVITY, load_vehicle
from perch_planner import refusals, relaxation, search
from perch_planner.planner import plan
from perch_planner.problem import Limits, PerchProblem, PerchSettings, StartState, Waypoint, contact_heading
from perch_planner.refusals import PerchRefusal
from perch_planner.time_allocation import FINE_DIVISIONS
from perch_planner.plan_output import requirements
from perch_planner.verifier import verify
from random_perches import paper_like_problem, random_problem, shipped_settings

VEHICLE = load_vehicle("snapdragon")
HOVER = StartState((0.0, 0.0, 1.5))
SLOW_IMPACT = PerchSettings(impact_speed_min=0.5, impact_speed_max=0.6, contact_delay=0.0)
"""An impact that takes less room than the shipped one."""


def surface(inclination_deg: float, heading_deg: float = 0.0, p=None) -> PerchSurface:
    if p is None:  # the vehicle rises as it turns over, from the lower the further
        p = (1.7, 0.0, 0.8 if inclination_deg < 30.0 else 1.5 if inclination_deg <= 140.0 else 3.6)
    return PerchSurface.from_inclination(np.array(p), np.radians(inclination_deg), np.radians(heading_deg))


def checked(problem: PerchProblem, settings: PerchSettings = PerchSettings()):
    """A plan that the verifier accepts and whose certificates all hold."""
    planned = plan(problem, settings, VEHICLE)
    kept = {c.quantity: c.holds for c in planned.certificates}
    need = requirements(problem, settings, VEHICLE)
    assert verify(planned.trajectory.durations, planned.trajectory.coefficients, need, step=5e-4) == []
    assert set(kept) == {"thrust", "speed", "height", "clearance", "body_rate", "rotor_thrust", "impact_speed"} and all(kept.values())
    return planned


@pytest.mark.parametrize("inclination", [0, 30, 60, 90, 105, 120, 135, 150, 165, 180])
def test_every_inclination_is_reached(inclination):
    target = surface(inclination)
    planned = checked(PerchProblem(HOVER, target))
    end = planned.trajectory.sample(planned.duration)
    state = flat_to_state(end.p, end.v, end.a, end.j, end.s, end.yaw, end.yaw_rate, end.yaw_acc, VEHICLE.mass)
    assert state.R_WB == pytest.approx(target.R_WS, abs=1e-6)  # B coincides with S at contact
    assert state.thrust == pytest.approx(VEHICLE.mass * max(3.3, GRAVITY * np.cos(np.radians(inclination)) - 0.5 * 0.65 / (0.12 + 0.04)))


def test_the_defaults_are_what_is_shipped():
    assert PerchSettings() == shipped_settings()


def test_turning_to_a_wall_stays_within_what_each_rotor_can_do():
    kept = {c.quantity: c for c in checked(PerchProblem(HOVER, surface(90.0)), PerchSettings(rotor_margin=0.005)).certificates}["rotor_thrust"]
    assert kept.holds and kept.method == "interval" and "proved" in str(kept)
    assert kept.lower_limit > VEHICLE.thrust_min and kept.upper_limit < VEHICLE.thrust_max


@pytest.mark.parametrize("inclination, height", [(160.0, 1.6), (180.0, 2.0)])
def test_what_takes_more_than_the_rotors_have_is_refused_and_says_what_it_would_take(inclination, height):
    """IPOPT finds no plan for two pairs of rotors in the plane either, from four starts and with any impact acceleration."""
    problem = PerchProblem(StartState((0.0, 0.0, 1.2)), PerchSurface.from_inclination((2.0, 0.0, height), np.radians(inclination)))
    with pytest.raises(PerchRefusal) as refusal:
        plan(problem, PerchSettings(), VEHICLE)
    assert set(refusal.value.relaxed) & {"height_min", "rotor_margin"}, refusal.value
    assert refusal.value.margin < 0.0
    assert all(c.holds for c in plan(problem, PerchSettings(**refusal.value.relaxed), VEHICLE).certificates)


@pytest.mark.parametrize("below", [0.5, 1.2])
def test_a_wall_half_a_metre_above_the_ground_is_reached_within_what_the_rotors_have(below):
    """By a finer division of the approach: with two pieces for the rotation no duration leads to a plan."""
    checked(PerchProblem(StartState((0.0, 0.0, below)), surface(90.0, p=(1.7, 0.0, 0.5))), SLOW_IMPACT)


@pytest.mark.parametrize("inclination, height", [(145.0, 1.6), (155.0, 2.0)])
def test_overhangs_with_little_room_below_are_reached_within_what_the_rotors_have(inclination, height):
    """By finer divisions of approaches whose coarse ones have failed."""
    checked(PerchProblem(StartState((0.0, 0.0, 1.2)), PerchSurface.from_inclination((2.0, 0.0, height), np.radians(inclination))), SLOW_IMPACT)


def test_a_negative_rotor_margin_lets_a_plan_ask_for_more_and_its_certificate_says_what():
    limits = Limits.of(PerchSettings(rotor_margin=-0.5), VEHICLE)
    spread = VEHICLE.thrust_max - VEHICLE.thrust_min
    assert limits.rotor_thrust == pytest.approx((VEHICLE.thrust_min - 0.5 * spread, VEHICLE.thrust_max + 0.5 * spread))


@pytest.mark.parametrize("inclination, settings, speed", [
    (90.0, {"impact_acceleration": 7.0}, 0.8), (135.0, {}, 0.8), (180.0, {}, 0.8), (0.0, {"impact_acceleration": 4.0, "impact_acceleration_fixed": True}, 0.65),
    (90.0, {"impact_speed_min": 0.7, "impact_speed_max": 0.7}, 0.7)])
def test_the_impact_window_holds_at_the_planned_contact_where_none_holds_for_a_late_one_too(inclination, settings, speed):
    """The plan is at the edge that is nearest to what the late contact asks for, and the certificate says so. [tests M:eq14]"""
    target = surface(inclination)
    planned = checked(PerchProblem(HOVER, target), PerchSettings(**settings))
    impact = {c.quantity: c for c in planned.certificates}["impact_speed"]
    assert impact.minimum == impact.maximum == pytest.approx(-planned.trajectory.sample(planned.duration).v @ target.normal, abs=1e-9)
    assert impact.maximum == pytest.approx(speed, abs=1e-6) and impact.time_of_maximum == planned.duration
    assert (impact.lower_limit, impact.upper_limit) == (settings.get("impact_speed_min", 0.65), settings.get("impact_speed_max", 0.8))


def test_the_slip_at_the_planned_contact_is_bounded_where_that_of_a_late_one_cannot_be():
    target = surface(90.0)
    planned = checked(PerchProblem(HOVER, target), PerchSettings(contact_delay=0.1))  # in which a wall's slip changes by 0.98 m/s
    assert np.linalg.norm(target.R_WS[:, :2].T @ planned.trajectory.sample(planned.duration).v) <= 0.3


def test_the_impact_speed_of_a_certificate_is_relative_to_a_moving_pad():
    target, velocity = surface(60.0), np.array([0.3, 0.1, 0.0])
    planned = checked(PerchProblem(HOVER, target, target_velocity=velocity))
    impact = {c.quantity: c for c in planned.certificates}["impact_speed"]
    assert impact.maximum == pytest.approx((velocity - planned.trajectory.sample(planned.duration).v) @ target.normal, abs=1e-9)


@pytest.mark.parametrize("heading", [-90.0, 90.0, 180.0])
def test_plans_turn_with_the_world(heading):
    """Turning the whole problem turns the plan; by right angles, because the tube is a box along the axes [M:eq15]."""
    reference = checked(PerchProblem(HOVER, surface(75.0)))
    angle = np.radians(heading)
    c, s = np.cos(angle), np.sin(angle)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    target = PerchSurface.from_inclination(R @ [1.7, 0.0, 1.5], np.radians(75.0), angle)
    turned = checked(PerchProblem(StartState(HOVER.p, yaw=angle), target))
    assert turned.duration == pytest.approx(reference.duration)
    for t in np.linspace(0.0, reference.duration, 7):
        assert turned.trajectory.sample(t).p == pytest.approx(R @ reference.trajectory.sample(t).p, abs=1e-5)


def test_both_sides_of_a_surface_can_be_approached():
    """A pad whose s2 points the other way is approached tail first: the roll direction is the target's."""
    target = surface(60.0)
    flipped = PerchSurface(target.p_WS, target.R_WS @ np.diag([-1.0, -1.0, 1.0]), target.size)
    forward = checked(PerchProblem(HOVER, target))
    backward = checked(PerchProblem(StartState(HOVER.p, yaw=np.pi), flipped))
    assert abs(contact_heading(flipped)) == pytest.approx(np.pi)
    assert backward.trajectory.sample(1.0).p == pytest.approx(forward.trajectory.sample(1.0).p, abs=1e-6)


def test_a_running_plan_is_replaced_in_flight():
    first = checked(PerchProblem(HOVER, surface(60.0)))
    start = StartState.on(first.trajectory, 0.6)
    moved = PerchSurface.from_inclination(np.array([1.8, 0.1, 1.5]), np.radians(65.0), 0.05)
    second = checked(PerchProblem(start, moved))
    before, after = first.trajectory.sample(0.6), second.trajectory.sample(0.0)
    for name, slack in (("p", 1e-9), ("v", 1e-9), ("a", 1e-8), ("j", 1e-6)):
        assert getattr(after, name) == pytest.approx(getattr(before, name), abs=slack)
    with pytest.raises(ConfigError, match="outside the current trajectory"):
        StartState.on(first.trajectory, first.duration + 0.1)


@pytest.mark.parametrize("inclination, velocity", [
    (0.0, (3.0, 0.0, 0.0)), (0.0, (8.0, 0.0, 0.0)), (0.0, (0.0, 8.0, 0.0)), (0.0, (-8.0, 0.0, 0.0)), (60.0, (3.5, 0.0, 0.0)),
    (60.0, (1.5, 0.5, 0.0)), (60.0, (-0.5, 0.0, 0.2))])
def test_moving_pads_are_met_where_they_are(inclination, velocity):
    target = surface(inclination)
    problem = PerchProblem(StartState(HOVER.p, v=(0.5, 0.0, 0.0)), target, target_velocity=np.array(velocity))
    planned = checked(problem)
    expected = target.p_WS + np.array(velocity) * planned.duration + VEHICLE.perch_offset * target.normal
    assert planned.trajectory.sample(planned.duration).p == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("options", [
    {"objective": "jerk"}, {"rotor_margin": 0.01}, {"minimum_time": True}])
def test_every_option_gives_plans_that_verify(options):
    points = (Waypoint((0.5, 0.1, 1.5)), Waypoint((0.9, 0.0, 1.5)))
    checked(PerchProblem(HOVER, surface(60.0), points), PerchSettings(**options))


@pytest.mark.parametrize("seed", [8, 15, 34, 58])
def test_no_program_that_has_a_solution_ends_the_search_at_its_durations(seed):
    planned = plan(paper_like_problem(np.random.default_rng(seed), 10), shipped_settings(), VEHICLE)
    assert len({attempt.duration for attempt in planned.attempts}) == 1


@pytest.mark.parametrize("seed", [98, 235, 334, 351])
def test_durations_whose_plans_recur_are_given_up(seed):
    """As the linearised bounds of the rotors then recur, too."""
    planned = plan(paper_like_problem(np.random.default_rng(seed), 10), shipped_settings(), VEHICLE)
    assert planned.iterations < 25


def test_minimum_time_is_shorter_and_still_verifies():
    problem = PerchProblem(HOVER, surface(60.0))
    usual, shortest = checked(problem), checked(problem, PerchSettings(minimum_time=True))
    assert shortest.duration < 0.9 * usual.duration


def test_minimum_time_also_shortens_a_plan_with_a_fine_division():
    problem = random_problem(np.random.default_rng(303))
    usual, shortest = checked(problem), checked(problem, PerchSettings(minimum_time=True))
    assert usual.trajectory.durations[-1] < 0.3 and shortest.duration < 0.95 * usual.duration


@pytest.mark.parametrize("guess", [(0.01, 1.0), (0.05, 1.2), (0.2, 1.2)])
def test_a_first_guess_that_is_far_too_short_leads_to_no_longer_plan_than_none(guess):
    problem = PerchProblem(HOVER, surface(80.0), (Waypoint((0.8, 0.0, 1.5)),))
    assert checked(replace(problem, segment_times=guess)).duration <= checked(problem).duration


@pytest.mark.parametrize("seed, guess", [(700110, (30.0, 1.0, 1.5)), (700112, (30.0, 1.0, 1.5))])
def test_a_first_guess_that_is_far_off_costs_no_plan(seed, guess):
    checked(replace(random_problem(np.random.default_rng(seed)), segment_times=guess))


def test_certificates_enclose_what_dense_sampling_finds():
    target, settings = surface(90.0), PerchSettings(contact_delay=0.03)
    planned = checked(PerchProblem(StartState(HOVER.p, yaw=0.6), target), settings)
    proofs = {c.quantity: c for c in planned.certificates}
    at = planned.trajectory.sample_many(np.linspace(0.0, planned.duration, 4001))
    states = [flat_to_state(*row, VEHICLE.mass) for row in zip(at.p, at.v, at.a, at.j, at.s, at.yaw, at.yaw_rate, at.yaw_acc)]
    thrust = np.array([s.thrust for s in states])
    rate = np.array([np.linalg.norm(s.w_WB_B) for s in states])
    speed = np.linalg.norm(at.v, axis=1)
    for values, name, slack in ((thrust, "thrust", 1e-3), (speed, "speed", 1e-3), (at.p[:, 2], "height", 2e-3), (rate, "body_rate", 0.15)):
        proof = proofs[name]
        assert proof.minimum <= values.min() + 1e-9 and values.max() <= proof.maximum + 1e-9
        assert proof.maximum <= values.max() * (1 + slack) + 1e-3
    force = at.a + (0.0, 0.0, GRAVITY)
    lean = np.linalg.norm(np.cross(force, target.normal), axis=1) / np.linalg.norm(force, axis=1)
    rim = (at.p - target.p_WS) @ target.normal - Limits.of(settings, VEHICLE).extension * lean
    assert rim.min() - 5e-3 <= proofs["clearance"].minimum <= rim.min() + 1e-9
    assert at.p[thrust.argmax(), 2] == pytest.approx(planned.trajectory.sample(proofs["thrust"].time_of_maximum).p[2], abs=0.05)


@pytest.mark.parametrize("problem, settings, code, constraint, margin", [  # of thrusts from 0.506 to 4.046 N, and 2.4525 N of a hover
    (PerchProblem(HOVER, surface(90.0)), {"impact_acceleration": 30.0}, refusals.UNREACHABLE_TILT, "thrust at contact m alpha", 4.046 - 7.5),
    (PerchProblem(HOVER, surface(90.0)), {"impact_acceleration": 1.0}, refusals.UNREACHABLE_TILT, "thrust at contact m alpha", 0.25 - 0.506),
    (PerchProblem(HOVER, surface(90.0)), {"thrust_max": 2.3}, refusals.THRUST_FLOOR, "hover thrust m g", 2.3 - 1.02 * 2.4525),
    (PerchProblem(HOVER, surface(90.0), segment_times=(0.5,)), {"thrust_max": 2.6, "duration_max": 8.0}, refusals.THRUST_FLOOR, "thrust range", "thrust_max"),
    (PerchProblem(HOVER, surface(90.0)), {"body_rate_max": 1.0, "duration_max": 6.0}, refusals.BODY_RATE, "body-rate limit", "body_rate_max"),
    (PerchProblem(HOVER, surface(90.0, p=(-1.0, 0.0, 1.5))), {}, refusals.BOX, "clearance of the start", -1.0 - 0.15),
    (PerchProblem(StartState((0.0, 0.0, 0.05)), surface(90.0)), {}, refusals.BOX, "height of the start", 0.05 - 0.15),
    (PerchProblem(StartState((0.0, 0.0, 1.5), a=(0.0, 0.0, -9.0)), surface(90.0)), {}, refusals.BAD_INPUT, "thrust of the start state", 0.2025 - 0.506),
    (PerchProblem(StartState((0.0, 0.0, 1.5), a=(0.0, 6.0, -9.81)), surface(90.0)), {}, refusals.BAD_INPUT, "heading of the start state", 0.0),  # b2_des
])
def test_refusals_name_the_constraint_and_its_margin(problem, settings, code, constraint, margin):
    """Of a search, `margin` names the limit: what it lacks to the least value with which there is a plan."""
    with pytest.raises(PerchRefusal) as caught:
        plan(problem, PerchSettings(**settings), VEHICLE)
    assert caught.value.code == code
    assert caught.value.margin < 0.0
    assert caught.value.margin == pytest.approx(settings[margin] - caught.value.relaxed[margin] if isinstance(margin, str) else margin, abs=2e-3)
    assert caught.value.constraint.startswith(constraint) and str(caught.value)


def test_rotors_of_a_plan_that_breaks_another_limit_are_not_called_proved():
    """They are sampled only."""
    with pytest.raises(PerchRefusal) as caught:
        plan(PerchProblem(HOVER, surface(90.0)), PerchSettings(speed_max=0.9), VEHICLE)
    rotors = next(c for c in caught.value.certificates if c.quantity == "rotor_thrust")
    assert rotors.holds and rotors.method == "dense" and "proved" not in str(rotors)


@pytest.mark.parametrize("x, words, margin", [
    (1.65, "0.050 m in front of the surface's plane; it needs more than 0.200 m", -0.15),
    (1.75, "0.050 m behind the surface's plane; it needs more than 0.200 m", -0.25)])
def test_a_waypoint_too_near_to_the_surface_is_told_where_it_is_and_what_it_lacks(x, words, margin):
    problem = PerchProblem(HOVER, surface(90.0), (Waypoint((x, 0.0, 1.5)),))
    with pytest.raises(PerchRefusal) as caught:
        plan(problem, PerchSettings(clearance_min=0.2), VEHICLE)
    assert words in str(caught.value) and caught.value.margin == pytest.approx(margin)


@pytest.mark.parametrize("waypoint", [(1.57, 0.17, 1.46), (1.58, -0.59, 1.68), (1.53, 0.76, 0.94), (1.55, -0.21, 1.47)])
def test_a_clearance_that_the_first_plan_lacks_is_kept(waypoint):
    problem = PerchProblem(HOVER, surface(90.0), (Waypoint(waypoint),))
    least = [next(c for c in checked(problem, PerchSettings(clearance_min=asked)).certificates if c.quantity == "clearance").minimum for asked in (0.0, 0.03)]
    assert least[0] < 0.03 <= least[1]


@pytest.mark.parametrize("inclination, velocity", [(0.0, (0.0, 0.0, 0.0)), (20.0, (0.0, 0.0, 0.0)), (20.0, (0.3, 0.0, 0.1))])
def test_the_plate_stays_in_front_of_the_surface_until_contact(inclination, velocity):
    """With so small an impact acceleration, the first plan comes from below."""
    target, settings = surface(inclination), PerchSettings(impact_acceleration_fixed=True)
    planned = checked(PerchProblem(HOVER, target, target_velocity=velocity), settings)
    t = np.linspace(0.0, planned.duration, 2000)
    at = planned.trajectory.sample_many(t)
    force = at.a + (0.0, 0.0, GRAVITY)
    plate = at.p - VEHICLE.perch_offset * force / np.linalg.norm(force, axis=1, keepdims=True)
    assert ((plate - target.p_WS - t[:, None] * velocity) @ target.normal).min() > -2e-4
    assert planned.iterations > 1


def test_a_start_or_waypoint_whose_plate_is_behind_the_surface_is_refused_before_the_search():
    for problem in (PerchProblem(StartState((1.66, 0.0, 0.83)), surface(0.0)), PerchProblem(HOVER, surface(0.0), (Waypoint((0.5, 0.0, 0.83)),))):
        with pytest.raises(PerchRefusal, match="it needs more than 0.040 m") as caught:
            plan(problem, PerchSettings(), VEHICLE)
        assert caught.value.code == refusals.BOX and caught.value.iterations == 0


@pytest.mark.parametrize("distance", [0.05, 0.07])  # at 0.1 m there is a plan
def test_a_refusal_for_a_waypoint_whose_rim_touches_a_wall_names_the_clearance_that_it_takes(distance):
    problem = PerchProblem(HOVER, surface(90.0), (Waypoint((1.7 - distance, 0.0, 1.5)),))
    with pytest.raises(PerchRefusal, match="clearance") as caught:
        plan(problem, PerchSettings(), VEHICLE)
    assert -0.3 < caught.value.relaxed["clearance_min"] < 0.0
    clearance = next(c for c in caught.value.certificates if c.quantity == "clearance")
    assert -np.inf < clearance.minimum < 0.0 and clearance.method == "dense"
    assert all(c.holds for c in plan(problem, PerchSettings(**caught.value.relaxed), VEHICLE).certificates)


def test_a_plan_longer_than_duration_max_is_refused_and_says_what_it_would_take():
    waypoints = tuple(Waypoint((-3.0 * (k % 2), 1.0 * (k % 3), 1.4)) for k in range(60))
    with pytest.raises(PerchRefusal, match="duration_max") as caught:
        plan(PerchProblem(HOVER, surface(90.0), waypoints), PerchSettings(), VEHICLE)
    assert caught.value.code == refusals.BOX and caught.value.margin < 0.0 and caught.value.relaxed["duration_max"] > 20.0


def test_a_contact_farther_away_than_speed_max_goes_in_duration_max_is_refused_before_the_search():
    waypoints = tuple(Waypoint((-8.0 * (k % 2), 0.0, 1.4)) for k in range(60))
    with pytest.raises(PerchRefusal, match="longer than speed_max 12 m/s covers in duration_max 20 s") as caught:
        plan(PerchProblem(HOVER, surface(90.0), waypoints), PerchSettings(), VEHICLE)
    assert caught.value.code == refusals.BOX and caught.value.iterations == 0
    assert caught.value.margin == pytest.approx(12.0 * 20.0 - (0.1 + 59 * 8.0 + np.hypot(9.7, 0.1) - abs(VEHICLE.perch_offset)))


@pytest.mark.parametrize("inclination, velocity, settings, least", [
    (90.0, (50.0, 0.0, 0.0), {}, 50.65), (90.0, (-50.0, 0.0, 0.0), {}, 49.2), (90.0, (0.0, 13.0, 0.0), {}, np.hypot(12.7, 0.65)),
    (180.0, (0.0, 0.0, 100.0), {}, 100.65), (90.0, (0.0, 0.0, 0.0), {"impact_speed_min": 15.0, "impact_speed_max": 20.0}, 15.0)])
def test_a_contact_that_is_faster_than_speed_max_is_refused_before_the_search(inclination, velocity, settings, least):
    problem = PerchProblem(HOVER, surface(inclination), target_velocity=velocity)
    with pytest.raises(PerchRefusal, match="the contact takes a speed of at least") as caught:
        plan(problem, PerchSettings(**settings), VEHICLE)
    assert (caught.value.code, caught.value.iterations) == (refusals.BOX, 0) and caught.value.margin == pytest.approx(12.0 - least)


@pytest.mark.parametrize("minimum_time", [False, True])
def test_first_durations_beyond_duration_max_are_no_refusal(minimum_time):
    """The first guess is longer than 1.2 s, the shortest plan is not."""
    planned = checked(PerchProblem(HOVER, surface(90.0)), PerchSettings(duration_max=1.2, minimum_time=minimum_time))
    assert planned.duration <= 1.2


def test_durations_grow_to_duration_max_before_a_refusal():
    problem, wanted = PerchProblem(HOVER, surface(90.0), segment_times=(0.5,)), PerchSettings()
    grown = plan(problem, wanted, VEHICLE).duration
    assert checked(problem, replace(wanted, duration_max=0.97 * grown)).duration <= 0.97 * grown


@pytest.mark.parametrize("early", [{1}, {4}, {5}, {6}, {4, 5}, {4, 5, 6, 7}])
def test_durations_of_duration_max_are_tried_with_all_divisions_of_the_approach(early, monkeypatch):
    """`early`: numbers of the tries whose thrust leaves its range before the last waypoint. Those durations grow at once."""
    problem, tried = PerchProblem(HOVER, surface(90.0, p=(3.0, 0.0, 1.5)), (Waypoint((1.0, 0.0, 1.5)),)), []
    searched = search.Search(problem, PerchSettings(), VEHICLE, Limits.of(PerchSettings(), VEHICLE))
    monkeypatch.setattr(searched, "try_durations", lambda durations, allow_stretch: tried.append(durations) or search.Outcome(durations, stretch=20.0))
    monkeypatch.setattr(searched, "fails_early", lambda durations, outcome: len(tried) in early)
    searched._run_from(searched.initial_durations)
    last = [tuple(durations) for durations in tried if durations.sum() == pytest.approx(20.0)]
    assert len(last) == len(set(last)) == 1 + len(FINE_DIVISIONS)


def test_durations_whose_approach_is_short_are_tried_once(monkeypatch):
    """A short approach is not divided: the next division would repeat the programs of the last one."""
    searched, tried = search.Search(PerchProblem(HOVER, surface(90.0)), PerchSettings(duration_max=0.8), VEHICLE, Limits.of(PerchSettings(), VEHICLE)), []
    monkeypatch.setattr(searched, "try_durations", lambda durations, allow_stretch: tried.append(tuple(durations)) or search.Outcome(durations))
    searched._run_from(np.array([0.5]))
    assert len(tried) == len(set(tried)) > 1


@pytest.mark.parametrize("seed, duration_max", [(700006, 5.76), (700007, 3.56), (700020, 2.8), (700067, 2.58)])
def test_at_duration_max_peaks_are_cut_that_longer_durations_would_reduce(seed, duration_max):
    """Peaks before the last waypoint, or beyond 1.7 times the limit."""
    settings = replace(shipped_settings(), duration_max=duration_max)
    assert checked(random_problem(np.random.default_rng(seed)), settings).duration == pytest.approx(duration_max)


def test_a_duration_max_without_room_for_the_tube_is_refused():
    with pytest.raises(PerchRefusal) as caught:
        plan(PerchProblem(HOVER, surface(90.0)), PerchSettings(duration_max=0.2), VEHICLE)
    assert set(caught.value.relaxed) == {"duration_max"}


@pytest.mark.parametrize("duration, divisions", [(3.0, 1 + len(FINE_DIVISIONS)), (0.8, 1)])
def test_a_shorter_duration_is_tried_once_with_each_division_of_the_approach(duration, divisions, monkeypatch):
    """A short approach is not divided. The division of the longer plan is tried first."""
    tried, searched = [], search.Search(PerchProblem(HOVER, surface(90.0)), PerchSettings(), VEHICLE, Limits.of(PerchSettings(), VEHICLE))
    monkeypatch.setattr(searched, "try_durations", lambda durations: tried.append(tuple(durations)) or search.Outcome(durations))
    for first in range(9):
        tried.clear()
        assert searched._try_divisions(np.array([duration]), first) is None
        assert len(tried) == len(set(tried)) == divisions and tried[0] == tuple(search.divided_durations(np.array([duration]), first))


def test_settings_may_be_integers():
    problem = PerchProblem(HOVER, surface(90.0))
    planned = plan(problem, replace(PerchSettings(), clearance_min=0, thrust_max=4, duration_max=20), VEHICLE)
    assert np.array_equal(planned.trajectory.coefficients, plan(problem, PerchSettings(thrust_max=4.0), VEHICLE).trajectory.coefficients)


@pytest.mark.parametrize("settings, names, words", [
    ({"body_rate_max": 1.0, "duration_max": 6.0}, {"body_rate_max"}, "body-rate limit"),  # the thrust leaves its range as often
    ({"thrust_max": 2.6, "duration_max": 8.0}, {"thrust_max"}, "thrust range"),
    ({"thrust_max": 2.6, "body_rate_max": 1.0, "duration_max": 6.0}, {"thrust_max", "body_rate_max"}, "thrust range .* and body-rate limit"),
    ({"duration_max": 0.6}, {"duration_max"}, "duration_max")])
def test_a_refusal_names_the_fewest_limits_and_values_that_do(settings, names, words):
    problem = PerchProblem(HOVER, surface(90.0), segment_times=(0.5,))
    with pytest.raises(PerchRefusal, match=words) as caught:
        plan(problem, PerchSettings(**settings), VEHICLE)
    assert set(caught.value.relaxed) == names and caught.value.margin < 0.0
    checked(problem, PerchSettings(**settings | caught.value.relaxed))


def test_a_refusal_does_not_try_plans_of_minutes(monkeypatch):
    """Their programs have hundreds of segments, each takes a second: the time limit ended them, and no cause was named."""
    tried, try_durations = [], search.Search.try_durations
    monkeypatch.setattr(search.Search, "try_durations",
                        lambda self, durations, *options, **more: tried.append(durations.sum()) or try_durations(self, durations, *options, **more))
    problem = PerchProblem(StartState((-2.8, -1.0, 3.0)), surface(90.0, p=(1.7, 0.0, 1.5)), (Waypoint((-2.8, -1.0, 3.0)), Waypoint((1.6, 0.0, 3.0))),
                           target_velocity=(0.0, 0.0, 7.0))
    with pytest.raises(PerchRefusal) as caught:
        plan(problem, PerchSettings(), VEHICLE)
    assert max(tried) <= 60.0 and caught.value.relaxed


def test_a_plan_that_a_search_without_a_limit_finds_is_taken_where_it_keeps_the_limit():
    settings = PerchSettings(speed_max=3.9, duration_max=3.9, tube_time=0.004, contact_delay=0.01, clearance_min=-0.0018)
    assert checked(random_problem(np.random.default_rng(71118)), settings).duration <= 3.9


def test_a_limit_that_is_looser_than_what_removes_it_is_kept():
    """A rotor that may stand still, and a body rate without bound."""
    vehicle = replace(VEHICLE, speed_min=0.0)
    problem, settings = PerchProblem(HOVER, surface(90.0)), PerchSettings(body_rate_max=2000.0)
    tried = search.Search(problem, settings, vehicle, Limits.of(settings, vehicle))
    used = relaxation._limit_usage(problem, tried.run().outcome, vehicle)
    assert relaxation._Trials(tried, relaxation._requested(settings, tried.limits))._violated(relaxation._LIMITS, used) == []


def test_the_clearance_that_a_refusal_names_is_near_what_a_plan_takes():
    """Between the samples the rim comes nearer by more than a tenth."""
    settings = PerchSettings(speed_max=2.8, duration_max=3.8433, tube_time=0.004, contact_delay=0.01, clearance_min=-0.0018, body_rate_max=2000.0)
    with pytest.raises(PerchRefusal) as caught:
        plan(random_problem(np.random.default_rng(50117)), settings, VEHICLE)
    assert -0.1 < caught.value.relaxed["clearance_min"] < settings.clearance_min


def test_values_that_remove_limits_are_the_loosest_valid_settings():
    """Else every plan violates a looser limit. A least thrust of 0 stands for the vehicle's."""
    ranges = {field.name: field.metadata for field in fields(PerchSettings)}
    loosest = {name: ranges[name]["high" if name.endswith("_max") else "low"] for name in relaxation._LIMITS if name != "thrust_min"}
    assert {name: relaxation._LIMITS[name].unlimited for name in loosest} == loosest


def test_a_rotor_margin_above_zero_is_reduced_to_zero_at_most_where_this_suffices():
    with pytest.raises(PerchRefusal) as caught:
        plan(PerchProblem(HOVER, surface(90.0)), PerchSettings(rotor_margin=0.4), VEHICLE)
    assert caught.value.relaxed["rotor_margin"] >= 0.0


@pytest.mark.parametrize("seed", [20010, 20063])
def test_a_refusal_solves_a_bounded_number_of_programs_and_names_limits_that_were_tried(seed, monkeypatch):
    solved, solve = [], search.solve

    def counted(*arguments):
        answer = solve(*arguments)
        solved.extend(answer[0])
        return answer

    monkeypatch.setattr(search, "solve", counted)
    problem = random_problem(np.random.default_rng(seed))
    with pytest.raises(PerchRefusal) as caught:
        plan(problem, PerchSettings(), VEHICLE)
    assert len(solved) <= search.ITERATIONS_MAX + relaxation.PROGRAMS_MAX
    assert caught.value.relaxed
    checked(problem, PerchSettings(**caught.value.relaxed))


def test_a_refusal_whose_programs_are_used_up_names_limits_without_which_there_is_a_plan(monkeypatch):
    monkeypatch.setattr(relaxation, "PROGRAMS_MAX", 10)
    problem = random_problem(np.random.default_rng(20010))
    with pytest.raises(PerchRefusal) as caught:
        plan(problem, PerchSettings(), VEHICLE)
    assert caught.value.relaxed and "even without" not in str(caught.value)
    assert all(abs(value) < 100.0 for value in caught.value.relaxed.values()), "what the plan takes, not the value that takes a limit away"
    plan(problem, PerchSettings(**caught.value.relaxed), VEHICLE)


def test_a_ceiling_near_the_floor_is_refused_for_the_floor():
    """Not for the thrust, of which it would take more than the vehicle has."""
    problem = PerchProblem(HOVER, surface(179.0))
    with pytest.raises(PerchRefusal, match="height limits") as caught:
        plan(problem, PerchSettings(height_min=1.2), VEHICLE)
    assert set(caught.value.relaxed) == {"height_min"}
    checked(problem, PerchSettings(**caught.value.relaxed))


@pytest.mark.parametrize("deg, height", [(179.0, 1.2), (179.0, 1.5), (180.0, 1.5)])
def test_a_low_ceiling_is_refused_for_the_floor_from_every_start(deg, height):
    with pytest.raises(PerchRefusal) as caught:
        plan(PerchProblem(StartState((0.0, 0.0, height)), surface(deg, p=(1.7, 0.0, 2.0))), PerchSettings(), VEHICLE)
    assert set(caught.value.relaxed) == {"height_min"}


@pytest.mark.parametrize("deg", [178.0, 180.0])
def test_a_ceiling_far_to_the_side_is_refused_for_the_floor(deg):
    """A search without that limit takes many programs."""
    problem = PerchProblem(StartState((0.0, 0.0, 1.2)), surface(deg, p=(1.2, 0.0, 2.0)))
    with pytest.raises(PerchRefusal) as caught:
        plan(problem, PerchSettings(), VEHICLE)
    assert set(caught.value.relaxed) == {"height_min"}
    checked(problem, PerchSettings(**caught.value.relaxed))


@pytest.mark.parametrize("key, value, suffices", [("duration_max", 0.5, 1.2), ("duration_max", 1.0, 1.2), ("height_min", 0.95, 0.7)])
def test_the_value_of_a_refusal_is_near_the_least_that_does(key, value, suffices):
    problem = PerchProblem(StartState((0.0, 0.0, 1.2)), surface(90.0, p=(1.7, 0.0, 1.2)))
    with pytest.raises(PerchRefusal) as caught:
        plan(problem, PerchSettings(**{key: value}), VEHICLE)
    assert abs(caught.value.relaxed[key] - value) <= abs(suffices - value)


@pytest.mark.parametrize("target, velocity", [
    (surface(0.0, p=(1.5, 0.0, 0.8)), (0.0, 0.0, -0.5)), (surface(90.0, p=(1.7, 0.0, 1.0)), (0.0, 0.0, -0.4))])
def test_a_pad_that_sinks_to_the_floor_is_met_before(target, velocity):
    """Only plans much shorter than the first guess meet it above `height_min`."""
    checked(PerchProblem(HOVER, target, target_velocity=np.array(velocity)))


@pytest.mark.parametrize("inclination", [60.0, 90.0, 110.0])
def test_no_plan_under_a_shorter_duration_max_is_shorter_than_minimum_time(inclination):
    problem = PerchProblem(StartState((0.0, 0.0, 1.2)), surface(inclination, p=(1.7, 0.0, 1.2)))
    shortest = checked(problem, PerchSettings(minimum_time=True)).duration
    for share in (0.97, 0.94, 0.9):
        with pytest.raises(PerchRefusal):
            plan(problem, PerchSettings(duration_max=share * shortest), VEHICLE)


@pytest.mark.parametrize("seed", [700052, 700280, 700365, 700370])
def test_a_search_that_fails_begins_again_from_other_durations(seed):
    """Random problems of which no plan is found from the first of `STARTS`."""
    problem = random_problem(np.random.default_rng(seed))
    assert checked(problem, PerchSettings()).iterations > search.STARTS[0][1]


@pytest.mark.parametrize("make, key", [
    (lambda: StartState((np.nan, 0.0, 0.0)), "p"), (lambda: StartState((0.0, 0.0, 0.0), yaw=np.inf), "yaw"),
    (lambda: Waypoint((0.0, 1.0)), "p"), (lambda: PerchProblem(HOVER, surface(90.0), segment_times=(1.0, 1.0)), "segment_times"),
    (lambda: PerchProblem(HOVER, surface(90.0), segment_times=(-1.0,)), "segment_times"),
    (lambda: PerchProblem(HOVER, surface(90.0), target_velocity=(0.0, np.inf, 0.0)), "velocity")])
def test_bad_values_are_named(make, key):
    with pytest.raises(ConfigError) as caught:
        make()
    assert caught.value.key == key


def test_limits_come_from_the_vehicle_unless_they_are_set():
    of_vehicle = Limits.of(PerchSettings(), VEHICLE)
    assert of_vehicle.thrust == pytest.approx((0.506, 0.9 * 4.496), abs=2e-3)  # the paper's range, with the reserve
    assert of_vehicle.body_rate == VEHICLE.body_rate_max
    assert Limits.of(PerchSettings(thrust_max=4.5), VEHICLE).thrust[1] == 4.5


@pytest.mark.parametrize("chunk", range(2))
@pytest.mark.slow
def test_random_problems_end_in_verified_plans_or_typed_refusals(chunk):
    """A slice of the campaign of 10,000 (bench/planner_campaign.py)."""
    planned = 0
    for seed in range(50 * chunk, 50 * chunk + 50):
        problem = random_problem(np.random.default_rng(seed))
        try:
            answer = plan(problem, PerchSettings(), VEHICLE)
        except PerchRefusal as refusal:
            assert refusal.margin < 0.0 and refusal.constraint
            continue
        need = requirements(problem, PerchSettings(), VEHICLE)
        assert verify(answer.trajectory.durations, answer.trajectory.coefficients, need, step=2e-3) == []
        planned += 1
    assert planned >= 40  # these problems are generous: most have a plan
