"""Orders, refusals, odometry judgement and each rule of the supervisor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from closed_loop.loop import make_loop, perch
from perch_control import monitors
from perch_control.admission import AtEnd, Order, TrajectoryRefused, check_joints, check_order, check_start
from perch_control.flight_settings import FlightSettings
from perch_control.guidance import Blend, Hold, Polynomial, blended, brake, quintic
from perch_control.maneuvers import following, hover_after_jump, recovered, stopped
from perch_control.modes import CommandRefused, State
from perch_control.odometry_gate import OdometryGate
from perch_control.recovery import Recovery
from perch_control.sensor_inputs import SensorInputs
from perch_control.reference import FlatReference, SampledReference, Setpoint
from perch_core import so3
from perch_core.errors import ConfigError
from perch_core.trajectory import FlatTrajectory, SampledTrajectory, rest_to_rest
from perch_core.values import Command, TrajectoryOrder
from perch_core.vehicle import load_vehicle

REST = (0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)


def hovering(**options):
    loop = make_loop(**options)
    loop.begin_in_hover()
    return loop


def moved(state, **parts):
    out = list(state)
    for key, value in parts.items():
        k = {"p": 0, "v": 3, "q": 6, "w": 10}[key]
        out[k:k + len(value)] = value
    return tuple(float(x) for x in out)


@pytest.mark.parametrize("change, word", [
    (dict(p=(0.5, 0, 1)), "position jumped by 0.50 m"), (dict(v=(3, 0, 0)), "velocity jumped by 3.00 m/s"),
    (dict(q=(0, 0, np.sin(0.5), np.cos(0.5))), "attitude jumped by 57 deg"),
])
def test_gate_names_what_it_refuses(change, word):
    gate = OdometryGate()
    assert gate.check(1.0, REST).usable
    verdict = gate.check(1.002, moved(REST, **change))
    assert not verdict.usable and word in verdict.reason
    assert gate.check(1.004, REST).usable, "the next good sample is taken again"


def test_gate_takes_a_jump_that_stays_and_refuses_old_stamps():
    gate = OdometryGate()
    gate.check(1.0, REST)
    assert "not after" in gate.check(1.0, REST).reason
    there = moved(REST, p=(1, 0, 1))
    verdicts = [gate.check(1.0 + 0.002 * k, there) for k in range(1, 20)]
    first = next(k for k, v in enumerate(verdicts) if v.usable)
    assert verdicts[first].jumped and first == 15
    assert not any(v.jumped for v in verdicts[first + 1:])


@pytest.mark.parametrize("place, limit", [((0, slice(0, 3)), 0.25), ((0, slice(3, 6)), np.radians(20.0)), ((1, slice(0, 3)), 1.5)])
def test_gate_does_not_take_a_jump_at_which_the_odometry_lost_itself_until_it_is_sure_again(place, limit):
    """However uncertain a long flight had made it before."""
    k, axes = place
    gate, drifted = OdometryGate(), (9.0 * np.eye(6), 9.0 * np.eye(6))
    gate.check(1.0, REST, drifted)
    there = moved(REST, p=(1, 0, 1))

    def taken(begin, sigma):
        covariances = tuple(np.array(c) for c in drifted)
        covariances[k][axes, axes] += sigma**2 * np.eye(3)
        verdicts = [gate.check(begin + 0.002 * n, there, covariances, flying=True) for n in range(1, 40)]
        return any(v.usable for v in verdicts), verdicts[-1].reason

    usable, reason = taken(1.0, 1.1 * limit)
    assert not usable and "jumped by 1.00 m" in reason and "less certain" in reason
    assert taken(1.1, 0.9 * limit)[0]


def test_at_rest_gate_takes_odometry_that_begins_anew_elsewhere_however_uncertain():
    gate = OdometryGate()
    gate.check(1.0, REST, (1e-4 * np.eye(6), 1e-4 * np.eye(6)))
    verdicts = [gate.check(1.0 + 0.002 * n, moved(REST, p=(1, 0, 1)), (4.0 * np.eye(6), np.eye(6)), flying=False) for n in range(1, 20)]
    assert not verdicts[0].usable and any(v.jumped for v in verdicts)


def test_gate_takes_a_jump_of_odometry_whose_velocity_has_no_covariance():
    gate, none = OdometryGate(), (np.zeros((6, 6)), -np.eye(6))
    gate.check(1.0, REST, none)
    assert any(gate.check(1.0 + 0.002 * k, moved(REST, p=(1, 0, 1)), none, flying=True).jumped for k in range(1, 20))


def test_gate_lets_fast_flight_pass():
    gate = OdometryGate()
    for k in range(100):
        t = 0.002 * k
        half = 6.0 * t
        assert gate.check(t, moved(REST, p=(8 * t, 0, 1), v=(8, 0, 0), q=(0, np.sin(half), 0, np.cos(half)), w=(0, 12, 0))).usable


def test_orders_are_refused_where_they_make_no_sense():
    loop = make_loop()
    with pytest.raises(CommandRefused, match="no usable odometry"):
        loop.controller.command(Command.ARM)
    loop.run(0.02)
    for command in (Command.HOVER, Command.LAND):
        with pytest.raises(CommandRefused, match="not flying"):
            loop.controller.command(command)
    with pytest.raises(TrajectoryRefused, match="disarmed"):
        loop.follow(rest_to_rest(np.zeros(3), np.array([0, 0, 1.0]), 0, 0, 2.0))
    loop.controller.command(Command.ARM)
    assert loop.controller.state is State.ARMED
    loop.controller.command(Command.DISARM)
    assert loop.controller.state is State.DISARMED


def test_motors_that_idle_without_an_order_are_stopped():
    loop = make_loop()
    loop.run(0.02)
    loop.controller.command(Command.ARM)
    loop.run(9.95)
    assert loop.controller.state is State.ARMED
    loop.run(0.1)
    assert loop.controller.state is State.DISARMED and "no trajectory for 10 s" in loop.controller.flight_state.message
    loop.controller.command(Command.ARM)
    loop.follow(rest_to_rest(np.zeros(3), np.array([0, 0, 1.0]), 0, 0, 2.0))
    loop.run(0.9)
    assert loop.controller.state is State.TRACKING, "a trajectory was to follow"


def test_arming_is_refused_on_the_side():
    loop = make_loop()
    loop.odometry = lambda plant: moved(plant.state, q=(np.sin(0.7), 0, 0, np.cos(0.7)))
    loop.run(0.02)
    with pytest.raises(CommandRefused, match="tilted"):
        loop.controller.command(Command.ARM)


@pytest.mark.parametrize("height, end", [(0.15, State.DISARMED), (0.6, State.HOVERING)])
def test_a_recovery_that_ends_at_the_ground_lands(height, end):
    loop = make_loop()
    loop.begin_in_hover((0.0, 0.0, height))
    loop.controller.flight_state = recovered(loop.controller.flight_state._replace(ground=0.0), "for a test")
    loop.run(4.0)
    assert loop.controller.state is end, loop.events


@pytest.mark.parametrize("tilt, share", [(85.0, 0.95), (60.0, 0.95), (95.0, 0.25), (180.0, 0.25)])
def test_a_recovery_turns_with_high_thrust_unless_that_would_push_the_vehicle_down(tilt, share):
    """19 of 20 m/s^2 brake the fall in the second half of the turn; b3 points down in the first. It leads the vehicle by 50 deg."""
    half = np.radians(tilt) / 2
    guidance = Recovery(20.0, moved(REST, q=(0.0, np.sin(half), 0.0, np.cos(half))), None)
    guidance.update(moved(REST, q=(0.0, np.sin(half), 0.0, np.cos(half))), 1.0)
    f = np.array(guidance.setpoint(0.0).a) + (0.0, 0.0, 9.81)
    assert np.linalg.norm(f) == pytest.approx(20.0 * share) and not guidance.finished
    assert np.degrees(np.arccos(f[2] / (20.0 * share))) == pytest.approx(tilt - 50.0, abs=1e-6)


def test_a_brake_that_is_ordered_again_is_still_that_of_a_trajectory_that_was_left_early():
    """No perch begins in it: by a second abort, or by odometry that jumps, it would be forgotten."""
    loop, _ = leaving()
    loop.controller.abort("stop it")
    x = loop.controller.flight_state
    assert x.left_early and x.mode is State.HOVERING
    assert stopped(x, "again").left_early and hover_after_jump(x, "odometry has jumped").left_early


@pytest.mark.parametrize("inclination", [0.0, 10.0, 20.0, 60.0])
def test_a_recovery_leaves_a_surface_of_any_inclination(inclination):
    turn = np.radians(inclination)
    loop, normal = make_loop(), (-np.sin(turn), 0.0, np.cos(turn))
    loop.begin_in_hover((0.0, 0.0, 3.0))
    loop.plant.R, begin = so3.exp(np.array([0.0, -turn, 0.0])), loop.plant.p.copy()
    loop.plant.wall = begin, np.array(normal)
    loop.controller._inputs = SensorInputs()  # odometry begins here: it has not jumped
    loop.run(0.002)
    loop.controller.flight_state = recovered(loop.controller.flight_state._replace(attached_to=normal), "for a test")
    assert loop.run(2.0, until=lambda x: x.controller.state is State.HOVERING), loop.events
    loop.run(1.0)
    assert (loop.plant.p - begin) @ normal > 0.25


@pytest.mark.parametrize("inclination, height", [(120.0, 1.1), (135.0, 1.5), (150.0, 1.8)])
def test_below_an_overhang_a_recovery_does_not_fly_to_the_floor(inclination, height):
    turn = np.radians(inclination)
    loop, normal = make_loop(floor=-10.0), np.array([-np.sin(turn), 0.0, np.cos(turn)])
    loop.begin_in_hover((0.0, 0.0, 3.0))
    loop.plant.R, contact = so3.exp(np.array([0.0, -turn, 0.0])), loop.plant.p.copy()
    loop.controller._inputs = SensorInputs()  # odometry begins here: it has not jumped
    loop.run(0.002)
    loop.controller.flight_state = recovered(loop.controller.flight_state._replace(attached_to=tuple(normal)), "for a test")
    lost, edge = [0.0], []

    def watch(x):
        lost.append(contact[2] - x.plant.p[2])
        sine = np.sqrt(max(1 - (x.plant.R[:, 2] @ normal) ** 2, 0.0))
        edge.append((x.plant.p - contact) @ normal + x.plant.vehicle.perch_offset - max(x.plant.vehicle.body_radii) * sine)
        return x.controller.state is State.HOVERING

    assert loop.run(3.0, until=watch), loop.events
    assert max(lost) < height and min(edge) > 0.0, (max(lost), min(edge))


def test_attached_stops_the_motors_and_arming_again_recovers():
    plan = perch("surface_90_1.7m")
    loop = hovering(floor=-10.0)
    loop.follow(plan.trajectory, AtEnd.CONTACT, id=2)
    loop.run(plan.trajectory.duration + 0.04)
    loop.controller.command(Command.ATTACHED, "test")
    loop.run(0.05)
    assert loop.controller.state is State.ATTACHED and np.all(np.array(loop.controller.flight_state.rotors.command) == 0)
    loop.controller.command(Command.ARM)
    assert loop.controller.state is State.RECOVERING
    assert loop.run(4.0, until=lambda x: x.controller.state is State.HOVERING), loop.events


def segment(**changes):
    base = rest_to_rest(np.array([0, 0, 1.2]), np.array([1, 0, 1.2]), 0, 0, 2.0)
    c = base.coefficients.copy()
    return FlatTrajectory(np.array([2.0, 1.0]), np.concatenate([c, np.repeat(c[:, :, -1:], 10, axis=-1) + changes.get("step", 0.0)]))


def test_trajectories_that_jump_inside_are_refused():
    check_joints(segment())
    with pytest.raises(TrajectoryRefused, match="jumps by 0.*at 2.000 s"):
        check_joints(segment(step=0.1))
    times = np.linspace(0, 1, 11)
    good = dict(times=times, p=np.outer(times, (1, 0, 0)), q=np.tile((0, 0, 0, 1.0), (11, 1)), v=np.tile((1.0, 0, 0), (11, 1)),
                w=np.zeros((11, 3)), a=np.zeros((11, 3)), dw=np.zeros((11, 3)), rotor_thrust=np.full((11, 4), 0.6))
    check_joints(SampledTrajectory(**good))
    bad = good | {"p": good["p"] + np.where(np.arange(11) > 5, 0.3, 0.0)[:, None]}
    with pytest.raises(TrajectoryRefused, match="position jumps"):
        check_joints(SampledTrajectory(**bad))


def test_trajectories_whose_velocity_jumps_inside_are_refused():
    """Positions are continuous: 0.5 m/s to rest, and 1 to 2 m/s within 10 ms, in which the hardest flight gains 0.6 m/s."""
    c = np.zeros((2, 4, 2))
    c[:, 0], c[:, 2] = ((0.0, 1.0), (1.0, 1.0)), 1.2
    with pytest.raises(TrajectoryRefused, match="velocity jumps by 0.500 m/s at 2.000 s"):
        check_joints(FlatTrajectory(np.array([2.0, 1.0]), c))
    times = np.linspace(0.0, 1.0, 101)
    for begin, end, jumps in ((1.0, 2.0, True), (1.0, 1.7, False)):
        v = np.outer(np.where(times > 0.5, end, begin), (1.0, 0.0, 0.0))
        p = np.concatenate([np.zeros((1, 3)), np.cumsum(0.5 * (v[1:] + v[:-1]) * 0.01, axis=0)])
        samples = SampledTrajectory(times, p, np.tile((0, 0, 0, 1.0), (101, 1)), v, np.zeros((101, 3)), np.zeros((101, 3)), np.zeros((101, 3)),
                                    np.full((101, 4), 0.6))
        if jumps:
            with pytest.raises(TrajectoryRefused, match="velocity jumps by .* at 0.510 s"):
                check_joints(samples)
        else:
            check_joints(samples)


@pytest.mark.parametrize("place, velocity, start, why", [
    ((0.3, 0.0, 0.0), (0.0, 0.0, 0.9), 5.0, ""), ((0.0, 0.36, 0.0), (0.0,) * 3, 5.0, "starts 0.36 m away from the vehicle"),
    ((0.0,) * 3, (0.0, 1.1, 0.0), 5.0, "starts 1.10 m/s from the vehicle's velocity"), ((0.0,) * 3, (0.0,) * 3, 4.6, ""),
    ((0.0,) * 3, (0.0,) * 3, 4.4, "starts 0.60 s in the past"), ((0.0,) * 3, (0.0,) * 3, 66.0, "starts 61.00 s in the future")])
def test_a_trajectory_begins_where_and_when_the_vehicle_is_and_as_fast(place, velocity, start, why):
    """A step of the velocity that feedback has to make up for is as bad as one of the place."""
    at_rest = FlatReference(FlatTrajectory(np.array([2.0]), np.zeros((1, 4, 2))))
    present = Setpoint(place, velocity)
    if why:
        with pytest.raises(TrajectoryRefused, match=why):
            check_start(Order(1, at_rest, start), 5.0, present)
    else:
        check_start(Order(1, at_rest, start), 5.0, present)


@pytest.mark.parametrize("duration, x, why", [
    (0.2, (0.0, 19.0), ""), (0.2, (0.0, 21.0), "velocity of 105 is beyond 100"), (0.05, (0.0, 0.0, 1.2), ""),
    (0.05, (0.0, 0.0, 1.3), "acceleration of 1040 is beyond 1000")])
def test_polynomials_with_derivatives_that_no_vehicle_flies_are_refused(duration, x, why):
    c = np.zeros((1, 4, len(x)))
    c[0, 0] = x
    order = TrajectoryOrder.of(1, FlatTrajectory(np.array([duration]), c))
    if why:
        with pytest.raises(TrajectoryRefused, match=why):
            check_order(order, load_vehicle("snapdragon"))
    else:
        check_order(order, load_vehicle("snapdragon"))


def test_sampled_trajectory_is_flown():
    trajectory = rest_to_rest(np.array([0, 0, 1.2]), np.array([1.5, 0.5, 1.4]), 0, 0, 1.5)
    from perch_core.flatness import flat_to_state
    from perch_core.so3 import quat_from_matrix

    loop = hovering()
    times = np.linspace(0, 1.5, 151)
    s = [flat_to_state(x.p, x.v, x.a, x.j, x.s, x.yaw, x.yaw_rate, x.yaw_acc, 0.25) for x in map(trajectory.sample, times)]
    sampled = SampledTrajectory(times, np.array([x.p_WB for x in s]), quat_from_matrix(np.array([x.R_WB for x in s])),
                                np.array([x.v_WB for x in s]), np.array([x.w_WB_B for x in s]), trajectory.sample_many(times).a,
                                np.array([x.dw_WB_B for x in s]), np.array([np.full(4, x.thrust / 4) for x in s]))
    loop.states.clear(), loop.references.clear()
    loop.controller.follow(Order(4, SampledReference(sampled, 0.25), loop.time + 0.04))
    loop.run(2.0)
    assert np.all(loop.rmse < 0.02) and loop.controller.state is State.HOVERING


def test_replacing_a_trajectory_keeps_the_reference_continuous():
    loop = hovering()
    p = loop.plant.p.copy()
    loop.follow(rest_to_rest(p, p + [2, 0, 0], 0, 0, 2.0), id=1)
    loop.run(1.0)
    x = loop.controller.flight_state.setpoint(0.04)
    # The new plan starts a little beside the running reference, as a re-plan on an estimate does.
    c = brake(np.array(x.p) + [0.05, 0.1, 0], x.v, x.a, x.h)._trajectory
    loop.references.clear()
    loop.follow(c, id=2)
    loop.run(0.8)
    r = np.array(loop.references)
    velocity = np.diff(r, axis=0) / 0.002
    assert np.abs(np.diff(velocity, axis=0) / 0.002).max() < 12.0
    assert loop.controller.flight_state.trajectory_id == 2


def test_blend_starts_on_the_old_and_ends_on_the_new_reference():
    old = Hold.at((0.2, 0.1, 1.0), (0, 1, 0)).setpoint(0)
    new = FlatReference(rest_to_rest(np.zeros(3), np.array([1, 0, 0]), 0, 0, 2.0))
    mixed = blended(old, new, 0.0, new.duration)
    np.testing.assert_allclose(mixed.setpoint(0.0).p, old.p, atol=1e-12)
    np.testing.assert_allclose(mixed.setpoint(1.0).p, new.setpoint(1.0).p, atol=1e-12)


def test_a_blend_at_one_time_is_the_blend_at_many_to_the_last_bit():
    """The controller asks for one time, the check of a contact for all."""
    source = FlatReference(rest_to_rest(np.zeros(3), np.array([1, 0, 0]), 0, 0, 2.0))
    offset = Polynomial(quintic((0.1, 0.2, 0.3), (1, 0, 0), (0, 2, 0), *np.zeros((3, 3)), 0.7), 0.7, (0.0, 0.0, 0.0))
    mixed, times = Blend(source, 0.4, offset), np.array([0.0, 0.4, 0.73, 1.1, 1.9, 2.5])
    assert [mixed.setpoint(float(t)).packed for t in times] == [tuple(row.tolist()) for row in mixed.many(times)]


@pytest.mark.parametrize("left, taken", [(0.2, 0.2), (0.4, 0.3), (0.8, 0.4), (3.0, 0.5)])
def test_a_late_takeover_uses_the_time_there_is(left, taken):
    """Four centimetres within 0.14 s ask for 10 m/s^2, which no vehicle follows."""
    new = FlatReference(rest_to_rest(np.zeros(3), np.array([1, 0, 0]), 0, 0, 4.0))
    begin = 4.0 - left
    old = Hold.at(np.add(new.setpoint(begin).p, (0.0, 0.0, 0.04)), (0, 1, 0)).setpoint(0)
    mixed = blended(old, new, begin, 4.0)
    off = [np.linalg.norm(np.subtract(mixed.setpoint(begin + share * taken).p, new.setpoint(begin + share * taken).p)) for share in (0.0, 0.9, 1.0)]
    assert off[0] == pytest.approx(0.04) and off[1] > 1e-5 and off[2] < 1e-9


def test_brake_meets_state_and_rest():
    b = brake((1, 2, 3), (2, -1, 0.5), (1, 0, -2), (0, 1, 0))
    x, y = b.setpoint(0.0), b.setpoint(b.duration + 1.0)
    np.testing.assert_allclose((*x.p, *x.v, *x.a), (1, 2, 3, 2, -1, 0.5, 1, 0, -2), atol=1e-12)
    np.testing.assert_allclose((*y.v, *y.a), 0.0, atol=1e-12)


@pytest.mark.parametrize("v, within, duration, peak", [
    ((0.2, 0.0, 0.0), np.inf, 0.4, 0.94), ((2.0, 0.0, 0.0), np.inf, 0.94, 4.0), ((3.0, -4.0, 0.0), np.inf, 2.34, 4.0), ((0.0, 0.0, -3.0), np.inf, 1.41, 4.0),
    ((3.0, -4.0, 0.0), 1.5, 1.5, 6.25), ((3.0, -4.0, 0.0), 0.1, 1.17, 8.0), ((0.0, 0.0, -3.0), 0.1, 0.70, 8.0), ((2.0, 0.0, 0.0), 3.0, 0.94, 4.0)])
def test_a_brake_leans_by_22_degrees_in_the_open_and_by_more_only_where_there_is_no_room(v, within, duration, peak):
    """4 m/s^2; before a surface 8 m/s^2 at most, and then it takes longer than there is time. Velocity falls all the way."""
    b = brake((0.0, 0.0, 5.0), v, (0.0, 0.0, 0.0), (0, 1, 0), within=within)
    motion = [b.setpoint(float(t)) for t in np.linspace(0.0, b.duration, 201)]
    assert b.duration == pytest.approx(duration, abs=0.01) and max(np.linalg.norm(x.a) for x in motion) == pytest.approx(peak, rel=0.01)
    assert (np.diff([np.linalg.norm(x.v) for x in motion]) < 1e-9).all()
    np.testing.assert_allclose(np.subtract(motion[-1].p, motion[0].p), 0.5 * b.duration * np.array(v), atol=1e-9)


@pytest.mark.parametrize("fault, expected, word", [
    ("fence", State.HOVERING, "geofence"), ("far", State.LANDING, "outside the geofence"), ("tilt", State.RECOVERING, "tilt"),
    ("rate", State.RECOVERING, "body rate"), ("error", State.RECOVERING, "away from the reference"),
    ("margin", State.LANDING, "limit"), ("heavy", State.LANDING, "weak rotors"), ("silence", State.LANDING, "no order"), ("coasting", State.HOVERING, "no VIO"),
    ("lost", State.LANDING, "no VIO"), ("diverged", State.LANDING, "diverged"),
])
def test_each_fault_leads_to_its_answer(fault, expected, word, monkeypatch):
    settings = FlightSettings(fence_high=(1.0, 20.0, 20.0), silence_time=0.5 if fault == "silence" else 60.0)
    loop = hovering(settings=settings)
    flight, p = loop.controller, loop.plant.p.copy()
    if fault in ("fence", "coasting", "lost"):
        loop.follow(rest_to_rest(p, p + [3, 0, 0], 0, 0, 3.0))
        loop.run(0.5)
    if fault == "far":
        flight.use(flight.law, flight.gains, FlightSettings(fence_high=(p[0] - 1.2, 20.0, 20.0)))
    elif fault == "tilt":
        loop.plant.w = np.array([0.0, 18.0, 0.0])
    elif fault == "rate":
        loop.plant.w = np.array([0.0, 0.0, 60.0])
    elif fault == "error":
        flight.flight_state = following(flight.flight_state, Hold.at(p + [1.5, 0, 0], (0, 1, 0)))
    elif fault == "margin":
        monkeypatch.setattr(monitors, "_MARGIN_MIN", 0.45)
        loop.plant.disturbances.mass_factor = 1.25
    elif fault == "heavy":
        loop.plant.disturbances.mass_factor = 1.7
    elif fault == "coasting":
        loop.controller.estimator(2, 1.2, "")
    elif fault == "lost":
        loop.controller.estimator(2, 3.2, "")
    elif fault == "diverged":
        loop.controller.estimator(3, 0.1, "covariance")
    reached = loop.controller.state is expected and word in flight.flight_state.message
    reached = reached or loop.run(3.0, until=lambda x: x.controller.state is expected and word in flight.flight_state.message)
    assert reached, (loop.controller.state, flight.flight_state.message, loop.events)


@pytest.mark.parametrize("p, outside", [
    ((-1.5, 0.0, 0.0), 0.5), ((2.25, 0.0, 0.0), 0.25), ((0.0, -3.5, 0.0), 0.5), ((0.0, 4.75, 0.0), 0.75), ((0.0, 0.0, -5.125), 0.125),
    ((0.0, 0.0, 7.0), 1.0), ((-1.5, 6.0, 5.0), 2.0), ((-1.0, 4.0, 6.0), 0.0), ((1.9, -2.9, -4.9), 0.0)])
def test_every_side_of_the_geofence_counts(p, outside):
    fence = FlightSettings(fence_low=(-1.0, -3.0, -5.0), fence_high=(2.0, 4.0, 6.0))
    assert monitors.TrackingMonitor(fence, 8.0).outside(p) == outside


def test_a_recovery_that_does_not_come_to_rest_descends_after_six_seconds():
    """Odometry that shows a vehicle which never slows down: it cannot recover by it for ever."""
    loop = hovering()
    x = recovered(loop.controller.flight_state, "for a test")
    x = x._replace(state_estimate=(*x.state_estimate[:3], 3.0, 0.0, 0.0, *x.state_estimate[6:]))
    supervisor = loop.controller.supervisor
    assert supervisor.act(x._replace(now=x.now + 5.9), False).mode is State.RECOVERING
    after = supervisor.act(x._replace(now=x.now + 6.1), False)
    assert after.mode is State.LANDING and after.message == "landing: the recovery did not come to rest"


@pytest.mark.parametrize("at_end, mode, message", [(AtEnd.LAND, State.LANDING, "landing after trajectory 3"),
                                                   (AtEnd.HOLD, State.HOVERING, "hovering at the end of trajectory 3")])
def test_a_trajectory_ends_as_its_order_says(at_end, mode, message):
    loop = hovering()
    loop.follow(rest_to_rest(loop.plant.p, loop.plant.p, 0, 0, 0.2), at_end, id=3)
    loop.run(0.26)
    assert (loop.controller.state, loop.controller.flight_state.message) == (mode, message)


def test_a_geofence_without_an_inside_is_refused():
    with pytest.raises(ConfigError, match="fence_low.*is not below fence_high"):
        FlightSettings(fence_low=(-20.0, -20.0, 20.0))


@pytest.mark.parametrize("tilt", [70.0, 135.0, 180.0])
def test_at_rest_and_tilted_stops_the_motors_whatever_odometry_says(tilt):
    loop, angle = hovering(), np.radians(tilt)
    force = (9.81 * np.sin(angle), 0.0, 9.81 * np.cos(angle))
    for k in range(800):
        loop.controller.imu(loop.time + 0.002 * k, (0.0, 0.0, 0.0), force)
        loop.controller.step(loop.time + 0.002 * k, loop.plant.state)
        if loop.controller.state is State.FAILED:
            break
    assert 0.1 < 0.002 * k < 1.5, "a blow is shorter"


@pytest.mark.parametrize("tilt, share, rate, pause, stops", [
    (70.0, 1.0, 0.0, 0.0, True), (135.0, 1.1, 0.0, 0.0, True), (180.0, 0.9, 0.4, 0.0, True), (50.0, 1.0, 0.0, 0.0, False), (70.0, 1.25, 0.0, 0.0, False),
    (70.0, 0.75, 0.0, 0.0, False), (70.0, 1.0, 0.6, 0.0, False), (70.0, 1.0, 0.0, 0.15, False)],
    ids=["wall", "overhang", "upside down", "leaning", "pulled up", "falling", "turning", "interrupted"])
def test_what_carries_a_tilted_vehicle_for_a_second_is_not_its_rotors(tilt, share, rate, pause, stops):
    """By the IMU alone, where the rotors' health and odometry tell nothing."""
    loop, angle, now = hovering(), np.radians(tilt), 0.0
    x, supervisor = loop.controller.flight_state, loop.controller.supervisor
    force, level = (share * 9.81 * np.sin(angle), 0.0, share * 9.81 * np.cos(angle)), (0.0, 0.0, 9.81)
    for _ in range(700):
        now += 0.002
        x = supervisor.imu(x, 100.0 + now, (0.0, rate, 0.0), level if 0.6 < now < 0.6 + pause else force)
        if x.mode is State.FAILED:
            break
    assert (x.mode is State.FAILED) is stops
    assert not stops or (1.0 < now < 1.2 and "at rest and tilted with the motors running" in x.message)


def test_a_descent_without_any_sensor_ends():
    loop = hovering()
    loop.controller.imu(loop.time, (0.0, 0.0, 0.0), (0.0, 0.0, 9.81))
    results = [loop.controller.step_blind(loop.time + 0.02 * k) for k in range(75)]
    assert results[40].armed and not results[-1].armed and loop.controller.state is State.FAILED


def along_x(start: float, p: float, v: float, duration: float, brakes: bool = False) -> SampledTrajectory:
    """Level states along x, at constant speed or braking to rest."""
    t = np.linspace(0.0, duration, 300)
    a = -v / duration if brakes else 0.0
    n, zero = len(t), np.zeros((len(t), 3))
    x = p + v * t + 0.5 * a * t * t
    hover = 9.81 * make_loop().controller.vehicle.mass / 4
    return SampledTrajectory(t, np.stack([x, 0 * t, 1.0 + 0 * t], 1), np.tile([0.0, 0, 0, 1], (n, 1)), np.stack([v + a * t, 0 * t, 0 * t], 1),
                             zero, np.tile([a, 0.0, 0.0], (n, 1)), zero, np.full((n, 4), hover), start)


def leaving(recovery_start: float = 1.6):
    """A hovering vehicle that has just begun to track a plan with an appended recovery."""
    loop = hovering()
    now, mass = loop.controller.flight_state.now, loop.controller.vehicle.mass
    plan = along_x(now, 0.0, 0.4, 2.5)
    loop.controller.follow(Order(7, SampledReference(plan, mass), now, AtEnd.RECOVER, 0.25, recovery_start))
    loop.run(0.1)
    assert loop.controller.state is State.TRACKING
    return loop, now


def ready(loop, start: float, planned: float, id: int = 7) -> None:
    order = along_x(planned, 0.4 * (planned - start), 0.4, 0.8, brakes=True)
    loop.controller.keep_ready(Order(id, SampledReference(order, loop.controller.vehicle.mass), planned, AtEnd.HOLD, 0.0, 0.0))


def test_a_way_out_that_jumps_inside_is_not_kept():
    loop, start = leaving()
    path = along_x(start + 0.6, 0.24, 0.4, 0.8, brakes=True)
    torn = replace(path, p=path.p + np.where(path.times > 0.4, 0.3, 0.0)[:, None])
    with pytest.raises(TrajectoryRefused, match="position jumps by 0.5"):
        loop.controller.keep_ready(Order(7, SampledReference(torn, loop.controller.vehicle.mass), start + 0.6))
    loop.run(0.1)
    loop.controller.abort("stop it")
    assert loop.controller.state is State.HOVERING, "there is no way out"


def test_an_abort_does_not_leave_by_a_recovery_that_begins_elsewhere():
    loop, start = leaving()
    elsewhere = along_x(start + 0.3, 1.5, 0.4, 0.8, brakes=True)
    loop.controller.keep_ready(Order(7, SampledReference(elsewhere, loop.controller.vehicle.mass), start + 0.3, AtEnd.HOLD, 0.0, 0.0))
    loop.controller.abort("stop it")
    loop.run(0.5)
    assert loop.controller.state is State.HOVERING and loop.plant.p[0] < 0.5, loop.events


def test_an_abort_leaves_by_the_next_planned_recovery():
    loop, start = leaving()
    for planned in (0.3, 0.6, 0.9):
        ready(loop, start, start + planned)
    loop.run(0.3)
    message = loop.controller.abort("stop it")
    assert "stop it" in message and "planned recovery in 0.2" in message
    loop.run(0.15)
    assert loop.controller.flight_state.order.start == start, "flown on until it begins"
    loop.run(0.15)
    assert loop.controller.flight_state.order.start == pytest.approx(start + 0.6)
    assert loop.controller.state is State.RECOVERING and "recovering as planned: stop it" in loop.controller.abort()
    loop.run(1.2)
    assert loop.controller.state is State.HOVERING
    assert np.linalg.norm(loop.controller.flight_state.state_estimate[3:6]) < 0.1


@pytest.mark.parametrize("others", [(), (("id", 6), 0.5), (("id", 7), 1.4)])
def test_without_a_way_out_of_this_plan_nearby_an_abort_brakes(others):
    loop, start = leaving()
    if others:
        ready(loop, start, start + others[1], id=others[0][1])
    loop.run(0.1)
    loop.controller.command(Command.HOVER, "cancelled")
    assert loop.controller.state is State.HOVERING


def test_near_the_wire_the_plans_own_recovery_is_the_way_out():
    loop, start = leaving(recovery_start=0.5)
    loop.run(0.1)
    loop.controller.command(Command.HOVER, "cancelled")
    assert loop.controller.state is State.TRACKING and "planned recovery in 0.3" in loop.controller.flight_state.message


def test_a_recovery_from_the_present_state_takes_the_place_of_the_appended_one():
    loop, start = leaving(recovery_start=0.5)
    ready(loop, start, start + 0.2)
    ready(loop, start, start + 0.5)
    loop.run(0.35)
    assert loop.controller.flight_state.order.start == start, "nobody aborts: the plan is flown to the wire"
    loop.run(0.1)
    assert loop.controller.flight_state.order.start == pytest.approx(start + 0.5)
    loop.run(1.5)
    assert loop.controller.state is State.HOVERING


def test_without_one_the_appended_recovery_is_flown():
    loop, start = leaving(recovery_start=0.5)
    ready(loop, start, start + 0.2)
    loop.run(0.6)
    assert loop.controller.flight_state.order.start == start
