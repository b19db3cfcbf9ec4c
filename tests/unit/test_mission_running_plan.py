"""A powerline plan in flight: better perches and ways out are asked for, one at a time, from states that lie ahead. [P:V-B]"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from perch_control.mission import (
    AdhesionMonitor, ControllerState, Goal, Inputs, MissionSettings, Phase, Plan, PowerlineMission, Refusal, State, Target)
from perch_control.mission.running_plan import RunningPlan
from perch_control.mission.requests import flown_order
from perch_control.smooth_position import START_BEFORE_CONTACT
from perch_core import so3
from perch_core.trajectory import SampledTrajectory
from perch_core.values import AtEnd
from perch_core.vehicle import GRAVITY

START, LENGTH = 10.0, 2.5
GOAL = Goal(4.2, 30.0, perch_point=np.array([5.0, 0.0, 4.75]), replan=True)
LEVEL = np.array([0.0, 0.0, 0.0, 1.0])
SETTINGS = MissionSettings()
AT_REST = State(np.zeros(3), LEVEL, np.zeros(3), np.zeros(3))


def states(duration: float) -> SampledTrajectory:
    """Along x at 2 m/s, with a body rate and unequal rotors."""
    t = np.linspace(0.0, duration, 200)
    zero = np.zeros((200, 3))
    return SampledTrajectory(t, np.stack([2.0 * t, 0 * t, 4.0 + 0 * t], 1), np.tile(LEVEL, (200, 1)), np.tile([2.0, 0, 0], (200, 1)),
                             np.tile([0.0, 1.5, 0.0], (200, 1)), zero, zero, np.tile([1.0, 2.0, 3.0, 4.0], (200, 1)))


def target(time: float, x: float = 5.0, sigma: float = 0.02) -> Target:
    return Target(time, np.array([x, 0.0, 4.75]), LEVEL, sigma, 0.01)


def running(length: float = LENGTH) -> RunningPlan:
    return RunningPlan.from_plan(answer(START, length), target(9.0), SETTINGS)


def answer(start: float, length: float, success: bool = True) -> Plan | Refusal:
    return Plan(dataclasses.replace(states(length + 0.8), start_time=start), length) if success else Refusal("")


def test_ways_out_start_from_the_plans_own_states_until_its_own_recovery_is_near():
    plan, time, starts = running(), START - 0.03, []
    while time < plan.plan.end - SETTINGS.way_out_until:
        query = plan.query(time, AT_REST, None, GOAL)
        if query is not None:
            assert query.recovery and plan.query(time, AT_REST, None, GOAL) is None, "one query at a time"
            np.testing.assert_allclose(query.state.p, [2.0 * (query.start_time - START), 0.0, 4.0], atol=1e-9)
            np.testing.assert_allclose(query.state.w, [0.0, 1.5, 0.0])
            np.testing.assert_allclose(query.state.rotor_thrust, [1.0, 2.0, 3.0, 4.0])
            time += query.latency
            assert query.start_time > time, "known before it is needed"
            ready, better = plan.answered(answer(query.start_time, 1.0), time)
            assert ready is not None and better is None
            starts.append(query.start_time)
        time += 0.02
    assert starts[-1] == pytest.approx(plan.plan.end - SETTINGS.way_out_until), "the last one is as late as it may be"
    gaps = np.diff([START, *starts, plan.plan.end])
    assert len(starts) >= 4 and gaps.max() < 0.65, "an abort finds one within the time that the controller flies on"


def test_the_last_way_out_leaves_the_wire_from_where_the_vehicle_is_beside_the_newest_map():
    plan, newest, time, asked = running(), target(12.0, x=5.06, sigma=0.05), START + LENGTH - 0.36, []
    beside, turn = np.array([0.03, 0.0, -0.05]), so3.quat_exp([0.0, 0.2, 0.0])
    while time < plan.plan.end + 0.3:
        planned = plan.state(time)
        present = State(planned.p + beside, so3.quat_multiply(turn, planned.q), planned.v + [0.1, 0.0, 0.0], planned.w)
        query = plan.query(time, present, newest, GOAL)
        if query is not None:
            asked.append(query)
            time += query.latency
            assert plan.answered(answer(query.start_time, 1.0), time)[0] is not None
        time += 0.02
    (query,) = asked
    assert query.recovery and query.start_time == pytest.approx(plan.plan.end, abs=0.021) and query.target is newest
    at_wire = plan.state(query.start_time)
    np.testing.assert_allclose(query.state.p, at_wire.p + beside, atol=1e-9)
    np.testing.assert_allclose(query.state.v, at_wire.v + [0.1, 0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(query.state.q, so3.quat_multiply(turn, at_wire.q), atol=1e-9)
    np.testing.assert_allclose(query.state.rotor_thrust, at_wire.rotor_thrust)


def test_a_way_out_that_is_answered_after_its_start_does_not_count():
    plan = running()
    query = plan.query(START, AT_REST, None, GOAL)
    assert plan.answered(answer(query.start_time, 1.0), query.start_time + 0.02) == (None, None)
    assert plan.ways_out.committed(plan.plan.end - 0.1) == "the planner answered too late"


def test_a_target_that_has_moved_is_perched_on_where_it_is_now():
    plan = running()
    query = plan.query(START + 0.1, AT_REST, target(10.0, x=5.26), GOAL)
    assert not query.recovery and query.target.p_WS[0] == 5.26
    np.testing.assert_allclose(query.perch_pose[0], plan.state(plan.plan.end).p + [0.26, 0.0, 0.0], atol=1e-9)
    ready, better = plan.answered(answer(query.start_time, plan.plan.end - query.start_time + 0.05), START + 0.3)
    assert ready is None and better.target.p_WS[0] == 5.26
    assert better.plan.end == pytest.approx(plan.plan.end + 0.05)


@pytest.mark.parametrize("length, success", [(4.0, True), (1.0, False)])
def test_a_detour_or_a_refusal_leaves_the_plan_as_it_is(length, success):
    plan = running()
    query = plan.query(START + 0.1, AT_REST, target(10.0, x=5.26), GOAL)
    assert plan.answered(answer(query.start_time, length, success), START + 0.3) == (None, None)
    assert plan.query(START + 0.32, AT_REST, None, GOAL).recovery, "the next thing is asked"


@pytest.mark.parametrize("time, x, goal", [
    (START + 0.1, 5.1, GOAL), (START + LENGTH - 0.6, 5.26, GOAL),
    (START + 0.1, 5.26, Goal(4.2, 30.0, perch_point=np.zeros(3)))])
def test_no_new_perch_for_centimetres_nor_at_the_end_nor_unasked(time, x, goal):
    assert running().query(time, AT_REST, target(10.0, x=x), goal).recovery


def test_a_target_known_worse_than_the_planned_one_is_not_followed():
    query = running().query(START + 0.1, AT_REST, target(10.0, x=5.26, sigma=0.03), GOAL)
    assert query.recovery
    assert running().shifted(START + 0.1, target(10.0, x=5.06, sigma=0.03), GOAL) is None
    assert running().shifted(START + 0.1, target(10.0, x=5.06, sigma=0.022), GOAL), "out of sight it gets a little less certain, and moves with the map"


@pytest.mark.parametrize("time", [START + 0.1, START + LENGTH - 0.4])
def test_the_plan_moves_with_the_wire(time):
    plan = running()
    way_out = plan.query(time, AT_REST, None, GOAL)
    assert (way_out is not None) == (time == START + 0.1), "near its end the plan has its own"
    following = plan.shifted(time, target(10.0, x=5.03), GOAL)
    assert following.plan.end == pytest.approx(plan.plan.end) and following.target.p_WS[0] == 5.03
    assert time - 0.02 < following.plan.start_time <= time, "the rest of it"
    for t in (time, plan.plan.end, plan.plan.end + 0.4):  # the recovery as well
        np.testing.assert_allclose(following.state(t).p, plan.state(t).p + [0.03, 0.0, 0.0], atol=1e-9)
        np.testing.assert_allclose(following.state(t).rotor_thrust, plan.state(t).rotor_thrust)
    if way_out is not None:
        assert following.answered(answer(way_out.start_time, 1.0), way_out.start_time - 0.05)[0] is not None, "what was asked still counts"


@pytest.mark.parametrize("time, x, goal", [
    (START + 0.1, 5.002, GOAL), (START + 0.1, 5.26, GOAL), (START + LENGTH - 0.1, 5.03, GOAL), (START - 0.1, 5.03, GOAL),
    (START + 0.1, 5.03, Goal(4.2, 30.0, perch_point=np.zeros(3)))])
def test_the_plan_stays_for_millimetres_for_another_wire_at_the_end_before_its_start_and_unasked(time, x, goal):
    assert running().shifted(time, target(10.0, x=x), goal) is None


def test_the_plan_moves_until_the_controller_flies_on_the_velocity():
    """One instant for both: before it the plan follows the map's corrections, after it the controller leaves them out."""
    for sooner, moves in ((0.01, True), (-0.01, False)):
        assert (running().shifted(START + LENGTH - START_BEFORE_CONTACT - sooner, target(10.0, x=5.03), GOAL) is not None) == moves


def test_a_plan_that_was_moved_is_ordered_from_its_states():
    following = running().shifted(START + 1.0, target(10.0, x=5.03), GOAL)
    order = flown_order(7, following.plan, 0.25)
    assert (order.id, order.at_end, order.contact_time) == (7, AtEnd.RECOVER, 0.25)
    assert order.recovery_start == pytest.approx(following.plan.end - following.plan.start_time)
    np.testing.assert_allclose(order.trajectory.p, following.states.p)


def test_an_answer_that_comes_too_late_is_not_used():
    plan = running()
    query = plan.query(START + 0.1, AT_REST, None, GOAL)
    assert plan.answered(answer(query.start_time, 1.0), query.start_time + 0.01) == (None, None)


def test_a_goal_that_is_cancelled_on_the_ground_says_so_even_where_no_way_out_of_its_plan_is_left():
    machine = PowerlineMission(SETTINGS)
    machine.start(GOAL, START)
    machine.phase, machine._running = Phase.TRACKING, running()
    time = machine._running.plan.end
    outputs = machine.tick(Inputs(time, AT_REST, True, ControllerState.DISARMED, "", 0, None, np.zeros((0, 3)), cancel=True))
    assert machine.message == outputs.outcome.message == "cancelled on the ground"


def tilted(angle: float) -> np.ndarray:
    return so3.quat_exp([0.0, -angle, 0.0])


@pytest.mark.parametrize("pitch", np.radians([20.0, 80.0, 180.0]))
def test_a_grip_is_felt_and_flight_beside_the_wire_is_not_taken_for_one(pitch):
    wire = Target(0.0, np.zeros(3), tilted(pitch), 0.01, 0.01)
    p, zero = np.array([-0.1, 0.0, 0.1]), np.zeros(3)

    def felt(q: np.ndarray, force: np.ndarray) -> bool:
        monitor = AdhesionMonitor()
        monitor.add(np.tile(force, (40, 1)))
        return monitor.attached(State(p, q, zero, zero), wire)

    carried = so3.quat_rotate(so3.quat_conjugate(tilted(pitch)), np.array([0.0, 0.0, GRAVITY]))
    assert felt(tilted(pitch), carried + [0.2, -0.1, 0.3])
    for thrust in np.linspace(0.0, 25.0, 26):  # no thrust looks like the wire's pull
        assert not felt(tilted(pitch), np.array([0.0, 0.0, thrust]))
    assert not felt(LEVEL, np.array([0.0, 0.0, GRAVITY])), "a hover beside the wire"
