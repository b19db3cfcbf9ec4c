"""Section IV-C as printed: its conditions are those of the planner that flies, its plans keep what it promises."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from perch_core import bernstein
from perch_core.errors import ConfigError
from perch_core.flatness import flat_to_state
from perch_core.surface import PerchSurface
from perch_core.vehicle import load_vehicle
from perch_planner import plan_checks, planner
from perch_planner.contact_constraints import Contact, conditions
from perch_planner.paper import paper_m
from perch_planner.problem import PerchProblem, PerchSettings, StartState, Waypoint

VEHICLE = load_vehicle("snapdragon")
SETTINGS = PerchSettings(thrust_max=4.5, impact_speed_min=0.5, impact_speed_max=0.6, contact_delay=0.0)  # of which the paper knows nothing
BOUNDS = 4.0 * VEHICLE.thrust_min / VEHICLE.mass, 4.5 / VEHICLE.mass


def problem(inclination_deg: float, points=()) -> PerchProblem:
    surface = PerchSurface.from_inclination(np.array([1.7, 0.2, 1.4]), np.radians(inclination_deg), 0.1)
    start = StartState((0.0, 0.0, 1.2), v=(0.2, 0.0, 0.1), yaw=0.4)
    return PerchProblem(start, surface, tuple(map(Waypoint, points)), segment_times=(len(points) + 1) * (1.0 / (len(points) + 1),))


CASES = [problem(60.0), problem(90.0), problem(60.0, ((0.6, 0.1, 1.2), (1.1, 0.0, 1.3))), problem(90.0, ((0.8, 0.2, 1.3),))]


@pytest.mark.parametrize("asked", CASES)
@pytest.mark.slow
def test_plans_keep_the_thrust_and_end_on_the_surface_as_those_that_fly_do(asked):
    printed, flies = paper_m.plan(asked, SETTINGS, VEHICLE), planner.plan(asked, SETTINGS, VEHICLE)
    assert printed.solved
    trajectory = printed.trajectory
    _, least, most, *_ = plan_checks.thrust_extrema(np.ascontiguousarray(trajectory.coefficients[:, :3]), trajectory.durations, *BOUNDS)
    assert BOUNDS[0] <= least and most <= BOUNDS[1]  # what Sturm's chain said is proved by subdivision
    start = trajectory.sample(0.0)
    for name in ("p", "v", "a", "j", "yaw", "yaw_rate"):
        assert getattr(start, name) == pytest.approx(getattr(asked.start, name), abs=1e-6)
    ends = []
    for found in (trajectory, flies.trajectory):
        end = found.sample(found.duration)
        ends.append(end)
        state = flat_to_state(end.p, end.v, end.a, end.j, end.s, end.yaw, end.yaw_rate, end.yaw_acc, VEHICLE.mass)
        assert state.R_WB == pytest.approx(asked.surface.R_WS, abs=1e-5)
        assert 0.5 - 1e-6 <= -end.v @ asked.surface.normal <= 0.6 + 1e-6
    for name in ("p", "a", "yaw"):
        assert getattr(ends[0], name) == pytest.approx(getattr(ends[1], name), abs=1e-6)
    for k, waypoint in enumerate(asked.waypoints):
        assert trajectory.sample(trajectory.durations[:k + 1].sum()).p == pytest.approx(waypoint.p, abs=1e-6)


def test_only_violating_segments_and_their_neighbours_grow_until_none_is_left():
    found = paper_m.plan(problem(60.0, ((0.3, 0.1, 1.2), (0.6, 0.1, 1.2), (0.9, 0.1, 1.3), (1.2, 0.0, 1.3))), SETTINGS, VEHICLE)
    assert found.solved and len(found.iterations) > 1
    for one, following in zip(found.iterations, found.iterations[1:]):
        grew = following.program.durations > one.program.durations
        near = [one.violated[max(i - 1, 0):i + 2].any() for i in range(len(grew))]
        assert one.violated.any() and grew.tolist() == near


def test_a_problem_without_durations_is_refused():
    with pytest.raises(ConfigError, match="segment_times"):
        paper_m.plan(replace(problem(90.0), segment_times=None), SETTINGS, VEHICLE)


def test_window_and_tube_are_those_of_what_flies():
    """[tests M:eq14, M:eq15]"""
    asked, durations = CASES[2], np.array([0.5, 0.6, 0.7])
    contact = Contact(asked, SETTINGS, VEHICLE.perch_offset)
    *_, (_, segments, places, orders, direction, lower, upper) = conditions(durations, False, contact.velocity, contact.problem)
    G, y, z = paper_m.inequalities(durations, asked.surface.R_WS, SETTINGS)
    tube, window = len(y) - 1, 0
    assert orders.tolist() == tube * [2] + 5 * [1]
    for row, bounds in ((window, (y[0], z[0])), *((1 + r, (y[1 + r], z[1 + r])) for r in range(tube))):
        r = tube if row == window else row - 1
        c = np.random.default_rng(r).normal(size=(3, 3, 15))  # any plan
        there = bernstein.evaluate(bernstein.derivative(c[segments[r]], int(orders[r])), places[r]) / durations[segments[r]]**orders[r]
        assert np.sum(G[row] * c.transpose(1, 0, 2).reshape(3, -1)) == pytest.approx(direction[r] @ there, rel=1e-9, abs=1e-9)
        assert bounds == pytest.approx((lower[r], upper[r]), abs=1e-6)


def test_all_derivatives_up_to_the_fourth_are_continuous():
    found = paper_m.plan(CASES[2], SETTINGS, VEHICLE).trajectory
    for before, after, T, U in zip(found.coefficients, found.coefficients[1:], found.durations, found.durations[1:]):
        for order in range(5):
            left = bernstein.evaluate(bernstein.derivative(before, order), 1.0) / T**order
            assert left == pytest.approx(bernstein.evaluate(bernstein.derivative(after, order), 0.0) / U**order, rel=1e-6, abs=1e-5)


@pytest.mark.parametrize("low, high, kept", [(0.98, 1.02, True), (1.02, 1.02, False), (0.98, 0.98, False), (0.0, 1.02, True)])
def test_algorithm_1_decides_both_thrust_limits(low, high, kept):
    trajectory = planner.plan(CASES[1], SETTINGS, VEHICLE).trajectory
    p = np.ascontiguousarray(trajectory.coefficients[:, :3])
    _, least, most, *_ = plan_checks.thrust_extrema(p, trajectory.durations, 0.0, 100.0)
    inside = [paper_m.keeps_thrust(c, T, VEHICLE.mass, low * least * VEHICLE.mass, high * most * VEHICLE.mass)
              for c, T in zip(p, trajectory.durations)]
    assert all(inside) == kept
