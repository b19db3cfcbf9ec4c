"""Goals one after the other, by the components that fly: what one goal leaves behind must not move the next."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from closed_loop.perched import perched
from perch_control.maneuvers import recovered
from perch_control.modes import State
from perch_core.values import ImuSample, TriggerRequest
from perch_eval.goal import goal_of
from perch_eval.in_process import arrange
from perch_sim.contact_event import ContactState
from perch_sim.scenario import load_scenario


def ended(loop, goal, limit=40.0):
    """Step until a goal has ended; its result."""
    sent, begun = loop.send("mission", goal), loop.time
    while sent.result is None and loop.time < begun + limit:
        loop.step()
    assert sent.result is not None, loop.trace.phases[-3:]
    return sent.result


def test_a_goal_sent_again_in_the_air_does_not_climb():
    scenario = load_scenario("surface_90")
    loop = arrange(scenario, 1, without=("target_localizer",))
    goal, heights = replace(goal_of(scenario), takeoff_height=1.2, search_timeout=1.0), []
    ground = loop.vehicle.simulation.state.p_WB[2]
    for _ in range(4):
        assert ended(loop, goal).error_code == 1  # NOT_FOUND
        heights.append(loop.vehicle.simulation.state.p_WB[2] - ground)
    loop.close()
    assert heights == pytest.approx([1.2] * 4, abs=0.12)


@pytest.mark.parametrize("name", ["surface_90", "line_80"])
def test_perch_depart_and_perch_again(name):
    """In one run of the stack; a goal while perched is answered with its reason.

    The second contact the controller takes for a miss, and pushes off, against velcro or gripper that hold: a perch all the same.
    """
    goal, first = goal_of(load_scenario(name)), perched(name)
    loop, result = first.loop, first.result
    flight, plant = loop.components["controller"].flight, loop.vehicle.simulation.plant
    for given_up in (False, True):
        if given_up:
            sent, begun = loop.send("mission", goal), loop.time
            while not plant.hold.active and loop.time < begun + 40.0:
                loop.step()
            flight.flight_state = recovered(flight.flight_state, "test")
            while sent.result is None and loop.time < begun + 60.0:
                loop.step()
            result = sent.result
        assert result is not None and result.success, (result, loop.trace.phases[-3:])
        assert flight.state is State.ATTACHED and plant.hold.active
        if not given_up:
            refused = ended(loop, goal)
            assert (refused.success, refused.error_code) == (False, 9) and "depart" in refused.message
        begun, answers = loop.time, loop.request("mission", "depart", TriggerRequest())
        while not answers and loop.time < begun + 10.0:
            loop.step()
        assert answers[0].success and not plant.hold.active and not plant.crashed, answers
        assert flight.state is State.HOVERING and np.linalg.norm(plant.state.v_WB) < 0.3
        assert np.linalg.norm(np.subtract(loop.trace.values("odometry")[-1].p_WB, plant.state.p_WB)) < 0.15
    assert not any(c.state == ContactState.COLLISION for c in loop.trace.contacts)
    loop.close()


def test_a_departure_from_where_nothing_is_perched_on_is_refused():
    loop = arrange(load_scenario("surface_90"), 1)
    answers = loop.request("mission", "depart", TriggerRequest())
    while loop.time < 1.2:
        loop.step()
    loop.close()
    assert [a.success for a in answers] == [False] and "not perched" in answers[0].message


def test_another_writers_bad_imu_samples_leave_no_trace_of_themselves():
    """400 that are not finite, with the stamps of the good ones, from a hover on."""
    scenario = load_scenario("surface_90")
    loop = arrange(scenario, 1)
    sent = loop.send("mission", goal_of(scenario))
    steps = 0
    while sent.result is None and loop.time < 60.0:
        stamp, steps = loop.step(), steps + 1
        if 1000 <= steps < 1400:
            for name in ("estimator", "controller", "mission"):
                loop.components[name].on_imu(ImuSample(stamp + (2_000_000, 1_000_000, 0)[steps % 3], (math.nan,) * 3, (0.0, 0.0, math.inf)))
    assert sent.result is not None and sent.result.success
    assert loop.trace.flight.digest(perched("surface_90").time) == perched("surface_90").digest
    loop.close()
