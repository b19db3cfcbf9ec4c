"""What stops a flight also ends what waits to be flown; what is stopped is not begun again by itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from closed_loop.loop import make_loop, perch
from closed_loop.plant import Disturbances
from perch_control.admission import AtEnd, Order, TrajectoryRefused
from perch_control.flight_settings import FlightSettings
from perch_control.modes import State
from perch_control.recovery import Recovery
from perch_control.reference import SampledReference
from perch_core.trajectory import rest_to_rest
from perch_core.values import Command, TriggerRequest
from perch_planner.problem import PerchSettings
from unit.controller_flight import Flight, hovering, parameters
from unit.test_control_supervisor import along_x, hovering as hovering_loop, leaving, moved, ready

NOWHERE = {"p_WB": (float("nan"),) * 3}


def waiting(flight: Flight, end=(1.0, 0.0, 0.6)) -> Flight:
    """With a trajectory that starts half a second from now."""
    path = flight.path(flight.plant.p, end, 1.5)
    flight.follow(replace(path, start_time=path.start_time + 0.5))
    flight.step(0.1)
    return flight


def abort(flight: Flight) -> None:
    flight.component.on_abort(TriggerRequest(), lambda done: None)


@pytest.mark.parametrize("stop", [
    lambda flight: flight.order(Command.HOVER), abort, lambda flight: flight.step(0.1, p_WB=(0.0, 1.0, 0.6))])
def test_a_hover_is_the_end_of_what_was_to_follow(stop):
    flight = waiting(hovering())
    stop(flight)
    flight.step(0.8)
    assert flight.state is State.HOVERING and abs(flight.plant.p[0]) < 0.05


@pytest.mark.parametrize("command, state", [(Command.ARM, State.ARMED), (Command.ATTACHED, State.ATTACHED)])
def test_an_abort_at_rest_is_the_end_of_what_was_to_follow(command, state):
    flight = Flight()
    flight.step(0.2)
    flight.order(command)
    waiting(flight, (0.0, 0.0, 0.6))
    abort(flight)
    flight.step(0.8)
    assert flight.state is state and flight.plant.p[2] < 0.01


@pytest.mark.parametrize("command, end", [(Command.HOVER, State.HOVERING), (Command.LAND, State.DISARMED)])
def test_a_command_that_is_repeated_brakes_like_one_that_is_given_once(command, end):
    stops = []
    for times in (1, 20):
        loop = hovering_loop()
        begin = loop.plant.p.copy()
        loop.follow(rest_to_rest(begin, begin + [10.0, 0.0, 0.0], 0.0, 0.0, 5.0))
        loop.run(2.5)
        for _ in range(times):
            loop.controller.command(command)
            loop.run(0.1)
        loop.run(8.0 if command is Command.LAND else 4.0, until=lambda x: x.controller.state is State.DISARMED)
        assert loop.controller.state is end
        stops.append(loop.plant.p - begin)
    np.testing.assert_allclose(stops[0], stops[1], atol=0.02)


@pytest.mark.parametrize("order", [lambda flight: flight.order(Command.HOVER), abort])
def test_a_hover_that_is_ordered_again_is_not_one_without_orders(order):
    flight = hovering()
    flight.component.reconfigure(replace(flight.component.config, flight=FlightSettings(silence_time=0.3)))
    p = flight.plant.p.copy()
    for _ in range(3):
        order(flight)
        flight.step(0.2)
        assert flight.state is State.HOVERING, flight.said
    assert np.linalg.norm(flight.plant.p - p) < 0.02
    flight.step(0.2)
    assert flight.state is State.LANDING and "no order for" in flight.component.flight.flight_state.message


def test_what_waited_when_the_motors_were_stopped_is_not_flown_when_they_run_again():
    flight = Flight()
    flight.step(0.2)
    flight.order(Command.ARM)
    waiting(flight, (0.0, 0.0, 0.6))
    flight.order(Command.DISARM)
    flight.order(Command.ARM)
    flight.step(0.8)
    assert flight.state is State.ARMED


def test_attached_does_not_undo_a_kill():
    flight = hovering()
    flight.order(Command.KILL)
    flight.order(Command.ATTACHED)
    assert flight.state is State.FAILED and "attached is refused: killed" in flight.said


def test_without_odometry_nothing_is_begun_from_rest():
    flight = Flight()
    flight.step(0.2)
    flight.order(Command.ARM)
    waiting(flight, (0.0, 0.0, 0.6)).step(0.8, **NOWHERE)
    assert flight.state is State.ARMED
    flight.order(Command.ATTACHED)
    flight.follow(flight.path(flight.plant.p, (0.0, 0.0, 0.6), 1.5))
    flight.step(0.1, **NOWHERE)
    assert flight.state is State.ATTACHED and "refused: no usable odometry" in flight.said


@pytest.mark.parametrize("command, delay, before, room", [
    (Command.LAND, 0.03, 0.25, 0.03), (Command.HOVER, 0.03, 0.45, 0.14), (Command.HOVER, 0.04, 0.25, 0.03), (Command.LAND, 0.04, 0.35, 0.04),
    (Command.HOVER, 0.04, 0.35, 0.04), (Command.LAND, 0.04, 0.45, 0.14), (Command.HOVER, 0.04, 0.55, 0.14)])
def test_a_stop_before_a_surface_keeps_the_room_that_the_body_needs(delay, before, room, command):
    """A brake stops a body radius (0.15 m) before the contact's place as long as 8 m/s^2 are enough for it; from 0.45 s before on they are not."""
    plan, loop = perch("surface_90_1.7m", PerchSettings(contact_delay=delay)), make_loop()
    loop.begin_in_hover()
    loop.follow(plan.trajectory, AtEnd.CONTACT, id=2)
    loop.run(0.04 + plan.trajectory.duration - before)
    loop.controller.command(command)
    nearest = []
    ended = State.DISARMED if command is Command.LAND else State.HOVERING
    loop.run(5.5, until=lambda x: nearest.append((x.plant.p - plan.contact) @ plan.normal) or x.controller.state is State.DISARMED)
    assert loop.controller.state is ended and min(nearest) > room and loop.plant.impact_speed < 1.0
    assert ended is State.DISARMED or np.linalg.norm(loop.plant.v) < 0.05


def test_a_landing_leaves_a_trajectory_by_its_planned_way_out():
    loop, start = leaving()
    ready(loop, start, start + 0.6)
    loop.run(0.3)
    loop.controller.command(Command.LAND, "low battery")
    assert loop.controller.state is State.TRACKING and "low battery; planned recovery in" in loop.controller.flight_state.message
    with pytest.raises(TrajectoryRefused, match="about to be left"):
        loop.follow(perch("surface_90_1.7m").trajectory, AtEnd.CONTACT, id=9)
    loop.run(0.4)
    assert loop.controller.state is State.RECOVERING
    loop.run(8.0, until=lambda x: x.controller.state is State.DISARMED)
    assert loop.controller.state is State.DISARMED and loop.plant.impact_speed < 1.0


def test_a_hover_at_the_ground_is_a_landing():
    flight = Flight()
    flight.step(0.5)
    flight.order(Command.ARM)
    flight.follow(flight.path((0, 0, 0), (0, 0, 0.6), 1.0))
    flight.step(0.1)
    flight.order(Command.HOVER)
    flight.step(2.0)
    assert flight.state is State.DISARMED


def continuation(loop, start: float, ahead: float = 0.0) -> Order:
    """The rest of the plan of `leaving`, from `ahead` seconds later on."""
    now = loop.controller.flight_state.now + ahead
    return Order(8, SampledReference(along_x(now, 0.4 * (now - start), 0.4, 2.5), loop.controller.vehicle.mass), now, AtEnd.RECOVER, 0.25, 1.6)


def test_an_abort_is_not_undone_by_a_plan_that_goes_on_from_its_brake():
    loop, start = leaving()
    loop.controller.abort("stop it")
    loop.run(0.02)
    with pytest.raises(TrajectoryRefused, match="being braked to a hover"):
        loop.controller.follow(continuation(loop, start))
    loop.run(1.0)
    assert loop.controller.state is State.HOVERING
    p = loop.plant.p.copy()
    loop.follow(rest_to_rest(p, p + [0.1, 0.0, 0.0], 0.0, 0.0, 1.0), AtEnd.CONTACT, id=9)


def test_a_stop_at_the_geofence_is_not_undone_by_a_plan_that_waits():
    loop, start = leaving()
    flight, (x, _, _) = loop.controller, loop.plant.p
    flight.follow(continuation(loop, start, ahead=0.05))
    flight.use(flight.law, flight.gains, FlightSettings(fence_high=(x - 0.01, 20.0, 20.0)))
    loop.run(0.5)
    assert [e[2] for e in loop.events[1:]] == ["tracking trajectory 7", "hover: 0.0 m outside the geofence"], loop.events


def test_what_waits_when_a_flight_is_stopped_at_the_geofence_is_not_begun_from_another_place():
    loop, start = leaving()
    flight, (x, _, _) = loop.controller, loop.plant.p
    later = along_x(start + 1.5, 0.6, 0.4, 1.0, brakes=True)
    flight.follow(Order(8, SampledReference(later, flight.vehicle.mass), start + 1.5))
    flight.use(flight.law, flight.gains, FlightSettings(fence_high=(x - 0.01, 20.0, 20.0)))
    loop.run(0.02)
    assert flight.state is State.HOVERING, loop.events
    flight.use(flight.law, flight.gains, FlightSettings())  # a gust is over, the vehicle is back inside
    loop.run(1.7)
    assert flight.state is State.HOVERING and loop.plant.p[0] < 0.3, loop.events
    assert "trajectory 8 was not started: it starts 0.4" in flight.flight_state.message


def test_a_take_off_outside_the_geofence_is_a_landing():
    flight = Flight()
    flight.component.reconfigure(replace(flight.component.config, flight=FlightSettings(fence_high=(-0.5, 20.0, 20.0))))
    flight.step(0.5)
    flight.order(Command.ARM)
    flight.follow(flight.path((0, 0, 0), (0, 0, 0.6), 1.0))
    flight.step(2.5)
    assert flight.state is State.DISARMED and flight.plant.p[2] < 0.05 and "landing: 0.5 m outside the geofence" in flight.said


def test_a_tilted_vehicle_recovers_before_it_lands_outside_the_geofence():
    loop, _ = leaving()
    flight = loop.controller
    flight.use(flight.law, flight.gains, FlightSettings(fence_high=(loop.plant.p[0] - 0.01, 20.0, 20.0)))
    level = flight.flight_state._replace(ground=flight.flight_state.state_estimate[2])
    assert flight.supervisor.act(level, False).mode is State.LANDING
    tilted = level._replace(state_estimate=(*level.state_estimate[:6], 0.0, 0.5, 0.0, 0.75**0.5, 0.0, 0.0, 0.0))
    assert flight.supervisor.act(tilted, False).mode is State.RECOVERING


def test_a_perch_may_begin_in_the_brake_at_the_end_of_a_move():
    loop = hovering_loop()
    p = loop.plant.p.copy()
    loop.follow(rest_to_rest(p, p + [0.5, 0.0, 0.0], 0.0, 0.0, 1.0))
    loop.run(1.1)
    assert loop.controller.state is State.HOVERING and loop.controller.flight_state.elapsed < loop.controller.flight_state.source.duration
    loop.follow(rest_to_rest(p + [0.5, 0.0, 0.0], p + [1.0, 0.0, 0.0], 0.0, 0.0, 1.0), AtEnd.CONTACT, id=2)


@pytest.mark.parametrize("before, kept", [(0.2, False), (0.2, True), (-0.1, False)])
def test_an_abort_that_leaves_by_the_plans_own_recovery_is_a_recovery_and_is_not_undone(before, kept):
    own = 0.5 if before > 0.0 else 0.05
    loop, start = leaving(recovery_start=own)
    loop.run(start + own - before - loop.controller.flight_state.now)
    loop.controller.abort("stop it")
    with pytest.raises(TrajectoryRefused, match="about to be left"):
        loop.controller.follow(continuation(loop, start))
    if kept:
        ready(loop, start, start + own + 0.05)
    loop.references.clear()
    loop.run(max(before, 0.0) + 0.02)
    assert loop.controller.state is State.RECOVERING and loop.controller.flight_state.message == "recovering as planned: stop it"
    loop.run(0.2)
    assert loop.controller.state is State.RECOVERING and (loop.controller.flight_state.order.start > start) is kept
    assert np.abs(np.diff(np.array(loop.references)[:, 0])).max() < 0.5 * 0.002 + 0.1 * kept, "the reference does not jump"
    loop.run(2.5)
    assert loop.controller.state is State.HOVERING
    loop.follow(rest_to_rest(loop.plant.p, loop.plant.p + [0.1, 0.0, 0.0], 0.0, 0.0, 1.0), AtEnd.CONTACT, id=9)


def shifted(loop, by) -> None:
    """From now on, odometry is off by as much."""
    loop.odometry = lambda plant: moved(plant.state, p=plant.p + by)


def test_a_landing_goes_on_where_odometry_has_jumped():
    loop = hovering_loop()
    loop.controller.command(Command.LAND)
    loop.run(0.5)
    assert loop.controller.state is State.LANDING
    shifted(loop, (1.0, 0.0, 0.0))
    assert loop.run(10.0, until=lambda x: x.controller.state is State.DISARMED) and loop.plant.impact_speed < 1.0, loop.events


@pytest.mark.parametrize("before", [0.1, -0.3])
def test_a_recovery_beside_a_surface_knows_it_where_odometry_has_jumped(before):
    plan, loop = perch("surface_90_1.7m"), make_loop(floor=-10.0)
    loop.begin_in_hover()
    loop.follow(plan.trajectory, AtEnd.CONTACT, id=2)
    loop.run(0.04 + plan.trajectory.duration - before)
    shifted(loop, (0.0, 0.4, 0.0))
    distances = []
    loop.run(0.1, until=lambda x: distances.append((x.plant.p - plan.contact) @ plan.normal))
    assert isinstance(loop.controller.flight_state.source, Recovery), loop.events
    loop.run(3.0, until=lambda x: distances.append((x.plant.p - plan.contact) @ plan.normal))
    assert loop.controller.state is State.HOVERING and (before < 0.0 or min(distances) > 0.0), loop.events
    assert distances[-1] > 0.25, "away from the wall"


@pytest.mark.parametrize("command, state", [(Command.ARM, State.ARMED), (Command.ATTACHED, State.ATTACHED)])
def test_what_waits_through_a_silence_at_rest_is_not_begun_in_its_middle(command, state):
    flight = Flight()
    flight.step(0.2)
    flight.order(command)
    waiting(flight, (0.0, 0.0, 0.6)).step(1.2, odometry=False)
    flight.step(0.3)
    assert flight.state is state and flight.plant.p[2] < 0.01


def test_a_recovery_that_begins_elsewhere_does_not_take_the_place_of_the_appended_one():
    loop, start = leaving(recovery_start=0.8)
    path = along_x(start + 0.8, 0.32 + 0.5, 0.4, 0.6, brakes=True)
    loop.controller.keep_ready(Order(7, SampledReference(path, loop.controller.vehicle.mass), start + 0.8))
    loop.run(0.9)
    assert loop.controller.flight_state.order.source.duration > 1.0, "the plan's own one is flown"


def test_a_slow_landing_of_strong_rotors_ends_on_the_ground():
    settings = FlightSettings(land_speed=0.1)
    flight = Flight(params=replace(parameters(), flight=settings), disturbances=Disturbances(rotor_factor=(1.2,) * 4)).take_off()
    height = flight.plant.p[2]
    flight.order(Command.LAND)
    flight.step(2.0)
    assert flight.state is State.LANDING and 0.1 < height - flight.plant.p[2] < 0.3
    flight.step(8.0)
    assert flight.state is State.DISARMED and flight.plant.p[2] < 0.01


@pytest.mark.parametrize("stream", ["on_imu", "on_odometry"])
@pytest.mark.parametrize("ahead", [0.1, 0.9])
def test_one_stamp_ahead_of_the_others_ends_nothing(stream, ahead):
    flight = hovering()
    stamp = flight.stamp + int(ahead * 1e9)
    getattr(flight.component, stream)((flight.imu if stream == "on_imu" else flight.odometry)(stamp=stamp))
    flight.step(0.3)
    assert flight.state is State.HOVERING and np.linalg.norm(flight.plant.v) < 0.05
