"""Ways out of a perch on a surface: from each instant of a plan to a hover, within the limits; flown when the perch is given up."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from closed_loop.loop import make_loop, perch
from perch_control.admission import AtEnd, Order, check_order
from perch_control.mission.ways_out import WaysOut
from perch_control.modes import State
from perch_control.reference import FlatReference
from perch_core.surface import PerchSurface
from perch_core.values import Command, TrajectoryOrder
from perch_core.vehicle import GRAVITY, load_vehicle
from perch_eval.control_flights.aborted import fly_cancelled
from perch_planner.problem import Limits, PerchProblem, PerchSettings, StartState
from perch_planner.refusals import PerchRefusal
from perch_planner.way_out import STANDOFF_MIN, plan_way_out

VEHICLE, SETTINGS = load_vehicle("snapdragon"), PerchSettings()
PLAN = perch("surface_90_1.7m")
WALL = PerchSurface.from_inclination(PLAN.contact - VEHICLE.perch_offset * PLAN.normal, math.pi / 2)
LOST_FOR = 1.5  # without VIO [s]


def way_out(t: float):
    """Of the stored plan, at a time [s]."""
    return plan_way_out(PerchProblem(StartState.on(PLAN.trajectory, t), WALL), SETTINGS, VEHICLE)


@pytest.mark.parametrize("left", [1.3, 0.9, 0.6, 0.4, 0.2, 0.15])
def test_a_way_out_continues_the_plan_keeps_the_limits_and_ends_at_rest_away_from_the_wall(left):
    t = PLAN.trajectory.duration - left
    found, limits = way_out(t), Limits.of(SETTINGS, VEHICLE)
    assert all(proof.holds for proof in found.certificates) and {p.quantity for p in found.certificates} >= {"clearance", "rotor_thrust", "thrust"}
    before, first, last = PLAN.trajectory.sample(t), found.trajectory.sample(0.0), found.trajectory.sample(found.trajectory.duration)
    for name in ("p", "v", "a", "j"):
        np.testing.assert_allclose(getattr(first, name), getattr(before, name), atol=1e-6)
    np.testing.assert_allclose([last.v, last.a], 0.0, atol=1e-6)
    assert (last.p - WALL.p_WS) @ WALL.normal >= STANDOFF_MIN - 1e-9
    for s in np.linspace(0.0, found.trajectory.duration, 400):
        x = found.trajectory.sample(s)
        force = VEHICLE.mass * (x.a + (0.0, 0.0, GRAVITY))
        assert limits.thrust[0] - 1e-6 <= np.linalg.norm(force) <= limits.thrust[1] + 1e-6
        lean = np.linalg.norm(np.cross(force, WALL.normal)) / np.linalg.norm(force)
        assert (x.p - WALL.p_WS) @ WALL.normal >= limits.extension * lean - 1e-6, "the rim stays in front of the wall"
        assert x.p[2] >= limits.height[0] - 1e-9


@pytest.mark.parametrize("left", [0.07, 0.08])
def test_the_controller_accepts_a_way_out_whose_coefficients_are_far_larger_than_its_accelerations(left):
    check_order(TrajectoryOrder.of(1, way_out(PLAN.trajectory.duration - left).trajectory), VEHICLE)


def test_where_there_is_none_the_refusal_names_the_limit():
    falling = StartState(np.array([0.0, 0.0, 0.4]), np.array([0.0, 0.0, -6.0]))
    with pytest.raises(PerchRefusal) as refusal:
        plan_way_out(PerchProblem(falling, WALL), SETTINGS, VEHICLE)
    # 6 m/s within 0.25 m take 72 m/s^2, and the rotors have 6 m/s^2 to spare
    assert refusal.value.code == "thrust_floor" and refusal.value.constraint == "thrust range [M:eq16]" and refusal.value.margin < 0.0
    assert str(refusal.value) == "no way out: no stop keeps the thrust within its range"


def test_at_the_wall_the_refusal_names_the_wall():
    with pytest.raises(PerchRefusal) as refusal:
        way_out(PLAN.trajectory.duration - 0.02)
    assert refusal.value.code == "box" and refusal.value.constraint == "clearance" and refusal.value.margin < 0.0


def test_a_plan_is_committed_once_no_way_out_is_left():
    ways = WaysOut(covered=0.0, until=1.0, spacing=0.4)
    assert ways.next(0.2) == 0.4 and ways.next(0.5) == 0.5 and not ways.committed(0.0)
    ways.answered(0.5, "")
    assert not ways.committed(0.4) and not ways.committed(0.6), "the next may be asked for"
    ways.answered(0.99, "thrust")
    assert ways.next(1.0) is None and not ways.committed(0.4) and ways.committed(0.6) == "thrust"


@pytest.mark.parametrize("covered, last", [(0.7, 1.0), (0.94, 1.0), (0.96, None)])
def test_the_last_way_out_is_as_late_as_it_may_be_unless_one_begins_just_before_it(covered, last):
    assert WaysOut(covered, until=1.0, spacing=0.4).next(0.9) == last


@pytest.mark.parametrize("before", [1.2, 0.25])
def test_a_cancelled_perch_leaves_by_a_way_out_and_ends_in_a_hover(before):
    flown = fly_cancelled("surface_90", 1, before)
    assert flown.planned and flown.end == "hovering" and flown.message == "cancelled; hovering"
    assert flown.rate < VEHICLE.body_rate_max and flown.margin > 0.0 and flown.distance > 0.0


def test_cancelled_too_late_the_perch_goes_on():
    flown = fly_cancelled("surface_90", 1, 0.1)
    assert flown.end == "attached" and flown.perched and flown.message.startswith("cancelled too late: perched (")


@pytest.mark.parametrize("left", [0.8, 0.4, 0.2])
def test_the_supervisor_leaves_by_a_way_out_where_vio_is_lost(left):
    loop = make_loop()
    loop.begin_in_hover()
    loop.plant.floor = -10.0
    start = loop.time + 0.04
    loop.follow(PLAN.trajectory, AtEnd.CONTACT)
    t = PLAN.trajectory.duration - left
    loop.run(t)
    found = way_out(t).trajectory
    loop.controller.keep_ready(Order(1, FlatReference(replace(found, start_time=start + t)), start + t))
    loop.controller.estimator(2, LOST_FOR, "")
    assert loop.run(0.1, until=lambda x: x.controller.state is State.RECOVERING)
    loop.controller.command(Command.HOVER)
    assert loop.controller.state is State.RECOVERING, "it is not cut short"
    assert loop.run(found.duration + 0.1, until=lambda x: x.controller.state is State.HOVERING), loop.events
    assert np.linalg.norm(loop.plant.v) < 0.3 and (loop.plant.p - PLAN.contact) @ PLAN.normal > 0.3
