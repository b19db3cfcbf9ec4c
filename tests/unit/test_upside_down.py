"""Falls that end upside down on the ground: the motors stop within 1.5 s, and the controller says FAILED."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from closed_loop.branches import branched
from perch_control.modes import State
from perch_core import so3
from perch_core.values import seconds
from perch_eval.goal import goal_of
from perch_eval.in_process import arrange
from perch_sim.scenario import load_scenario

HOVER = 3.6  # [s]


def upside_down(loop):
    """A blow has turned the vehicle over."""
    plant = loop.vehicle.simulation.plant
    plant.place(plant.state.p_WB * (1, 1, 0) + (0, 0, 0.1), np.array([1.0, 0, 0, 0]), np.zeros(3), np.zeros(3), plant.rotor_speed)
    return loop.time


def imu_fails(loop, lasting):
    """The IMU gives nothing but NaN for a while."""
    end = loop.time + lasting
    for name in ("estimator", "controller", "mission"):
        loop.filters[name, "imu/data_raw"] = lambda now, s: s._replace(w_B=(math.nan,) * 3) if seconds(now) < end else s
    return end if math.isfinite(end) else loop.time + 0.3  # the time that a fall takes


def controller_stops(loop, lasting):
    """The controller gets and says nothing for a while, and finds the vehicle turned over."""
    end, motors = upside_down(loop) + lasting, loop.vehicle.simulation.motors
    for channel in ("odometry", "imu/data_raw"):
        loop.filters["controller", channel] = lambda now, value: value if seconds(now) > end else None
    command = motors.command
    motors.command = lambda now, armed, speeds: command(now, armed and now * 1e-9 > end, speeds)
    return end


@pytest.fixture(scope="module")
def hovering():
    """A flight on its way; each fault comes to it as it is here. Without L1: its falls end upside down."""
    scenario = replace(load_scenario("surface_90"), parameters={"controller": {"controller.adaptive": False}})
    loop = arrange(scenario, 1)
    loop.send("mission", goal_of(scenario))
    while loop.time < HOVER:
        loop.step()
    yield loop
    loop.close()


def failed(loop, fault, lasting):
    """The controller's state when it has failed, or the vehicle has lain for 1.5 s, and what it says."""
    since = fault(loop) if lasting is None else fault(loop, lasting)
    flight, plant = loop.components["controller"].flight, loop.vehicle.simulation.plant
    while loop.time < since + 0.2 or so3.quat_to_matrix(plant.state.q_WB)[2, 2] > 0.0 or np.linalg.norm(plant.state.v_WB) > 0.05:
        loop.step()
        assert loop.time < since + 3.0, "it does not lie there"
    lying = loop.time
    while flight.state is not State.FAILED and loop.time < lying + 1.5:
        loop.step()
    return flight.state, flight.flight_state.message


@pytest.mark.parametrize("fault, lasting", [(upside_down, None), (imu_fails, 1.0), (imu_fails, math.inf), (controller_stops, 0.6),
                                            (controller_stops, 1.0)])
def test_upside_down_on_the_ground_is_failed_within_one_and_a_half_seconds(fault, lasting, hovering):
    state, message = branched(lambda: failed(hovering, fault, lasting))
    assert state is State.FAILED, (state, message)
