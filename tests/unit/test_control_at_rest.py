"""The controller at rest, on the ground and on a perch: when motors start, idle and stop, and what waits for its start."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from perch_control.flight_settings import FlightSettings
from perch_control.modes import State
from perch_core import so3
from perch_core.values import Command, EstimatorHealth, ImuSample, OdometryState
from unit.controller_flight import Flight, hovering, parameters

_NONE = np.zeros((6, 6))
PERCH = (0.0, 0.0, 0.6)  # where `hovering` hovers


def carried(flight: Flight, p, roll_deg: float = 0.0, v=(0.0, 0.0, 0.0), seconds: float = 0.2) -> None:
    """Feed a place that something other than the rotors gives the vehicle."""
    q = so3.quat_exp(np.radians([roll_deg, 0.0, 0.0]))
    f_B, v_B = so3.quat_rotate(so3.quat_conjugate(q), np.array([(0.0, 0.0, 9.81), v]))
    for _ in range(round(seconds * 1e9 / flight.period)):
        flight.component.on_imu(ImuSample(flight.stamp, (0.0, 0.0, 0.0), tuple(f_B.tolist()), "imu_link"))
        flight.component.on_odometry(OdometryState(flight.stamp, tuple(p), tuple(q.tolist()), tuple(v_B.tolist()), (0.0, 0.0, 0.0), _NONE, _NONE))
        flight.stamp += flight.period


def armed() -> Flight:
    flight = Flight()
    flight.step(0.3)
    flight.order(Command.ARM)
    flight.step(0.1)
    assert flight.state is State.ARMED
    return flight


def attached() -> Flight:
    flight = hovering()
    flight.order(Command.ATTACHED)
    carried(flight, PERCH, 180.0)
    assert flight.state is State.ATTACHED
    return flight


def test_a_vehicle_that_lies_below_its_perch_is_not_started():
    flight = attached()
    carried(flight, (0.0, 0.0, 0.05), 180.0)
    flight.order(Command.ARM)
    assert flight.state is State.ATTACHED and "arm is refused: the vehicle has come off" in flight.said
    flight.follow(flight.path((0, 0, 0.05), (0, 0, 0.6), 1.0))
    carried(flight, (0.0, 0.0, 0.05), 180.0)
    assert flight.state is State.ATTACHED and "trajectory 5 refused: the vehicle has come off" in flight.said
    assert not flight.motors[-1].armed


def test_a_vehicle_whose_odometry_begins_anew_on_its_perch_departs_once_it_is_called_attached_again():
    """Only people can tell that from a fall; the refusal says both."""
    flight = attached()
    carried(flight, (0.0, 0.0, 0.05), 180.0)
    flight.order(Command.ARM)
    assert flight.state is State.ATTACHED and "it is still held, and the surface has carried it down or odometry has begun anew" in flight.said
    flight.order(Command.ATTACHED)
    flight.order(Command.ARM)
    assert flight.state is State.RECOVERING, flight.said


def test_a_vehicle_that_was_taken_off_its_wall_by_hand_is_not_started():
    flight = Flight()
    carried(flight, PERCH, 90.0)
    flight.order(Command.ATTACHED)
    carried(flight, (0.3, 0.0, 0.6))
    flight.order(Command.ARM)
    assert flight.state is State.ATTACHED and "arm is refused: the vehicle stands upright, off its perch" in flight.said
    flight.follow(flight.path((0.3, 0.0, 0.6), (0.0, 0.0, 1.2), 1.0))
    assert "trajectory 5 refused: the vehicle stands upright" in flight.said
    flight.order(Command.DISARM)
    carried(flight, (0.3, 0.0, 0.6))
    flight.order(Command.ARM)
    assert flight.state is State.ARMED, flight.said


@pytest.mark.parametrize("p, v", [(PERCH, (0.0, 0.0, 0.0)), ((2.0, 0.0, 0.6), (0.5, 0.0, 0.0)), ((0.0, 0.0, 0.05), (0.0, 0.0, -3.0))],
                         ids=["where it was", "carried away by the surface", "still falling"])
def test_a_vehicle_on_its_perch_or_falling_from_it_is_started(p, v):
    flight = attached()
    carried(flight, p, 180.0, v, 0.05)
    flight.order(Command.ARM)
    assert flight.state is State.RECOVERING, flight.said


@pytest.mark.parametrize("roll_deg, state", [(43.0, State.ARMED), (47.0, State.DISARMED), (180.0, State.DISARMED)])
def test_a_vehicle_that_is_tipped_over_while_armed_is_disarmed(roll_deg, state):
    flight = armed()
    carried(flight, (0.0, 0.0, 0.05), roll_deg)
    assert flight.state is state and ("tilted by more than 45 deg" in flight.said) is (state is State.DISARMED)
    flight.order(Command.ARM)
    assert flight.state is state


def test_motors_do_not_run_in_the_hands_of_who_carries_the_vehicle():
    flight, carrying = armed(), (0.6, 0.0, 0.0)
    carried(flight, (0.0, 0.0, 0.05), v=carrying)
    assert flight.state is State.DISARMED and "disarmed: the vehicle moves with 0.6 m/s" in flight.said
    flight.order(Command.ARM)
    assert flight.state is State.DISARMED and "arm is refused: the vehicle moves with 0.6 m/s" in flight.said
    carried(flight, (0.0, 0.0, 0.05))
    flight.order(Command.ARM)
    assert flight.state is State.ARMED


def test_below_the_ground_that_it_was_armed_on_a_vehicle_that_has_left_a_perch_is_in_the_air():
    flight = hovering()
    flight.component.flight.flight_state = flight.component.flight.flight_state._replace(ground=2.6)
    flight.order(Command.ATTACHED)
    flight.order(Command.ARM)
    flight.step(2.5)
    x = flight.component.flight.flight_state
    assert x.mode is State.HOVERING and not x.at_ground


def test_a_hover_does_not_land_while_a_trajectory_waits():
    flight = hovering()
    flight.component.reconfigure(replace(flight.component.config, flight=FlightSettings(silence_time=2.0)))
    path = flight.path(flight.plant.p, (1.0, 0.0, 0.6), 2.0)
    flight.follow(replace(path, start_time=path.start_time + 2.0))
    flight.step(2.5)
    assert flight.state is State.TRACKING, flight.said
    flight.step(4.0)
    assert flight.state is State.LANDING and "no order for 2 s" in flight.said


@pytest.mark.parametrize("health, why", [(2, "no VIO for 1.4 s"), (3, "the estimator has diverged: lost")])
def test_no_take_off_without_an_estimator(health, why):
    flight = armed()
    flight.component.on_estimator(EstimatorHealth(flight.stamp, health, 1.4, 0, 0, 0.0, (0.0,) * 3, (0.0,) * 3, 0.0, 0.0, "lost"))
    flight.follow(flight.path((0, 0, 0), PERCH, 1.0))
    flight.step(0.1)
    assert flight.state is State.ARMED and f"trajectory 5 refused: {why}" in flight.said
    flight.component.on_estimator(EstimatorHealth(flight.stamp, 2, 0.4, 0, 0, 0.0, (0.0,) * 3, (0.0,) * 3, 0.0, 0.0, "a frame is late"))
    flight.follow(flight.path((0, 0, 0), PERCH, 1.0))
    flight.step(0.1)
    assert flight.state is State.TRACKING


def test_a_trajectory_that_waits_is_not_begun_from_another_place():
    flight = armed()
    path = flight.path((0, 0, 0), PERCH, 1.0)
    flight.follow(replace(path, start_time=path.start_time + 1.0))
    for x in np.linspace(0.0, 0.5, 22):
        carried(flight, (x, 0.0, 0.0), v=(0.5, 0.0, 0.0), seconds=0.05)
    assert flight.state is State.ARMED
    assert "trajectory 5 was not started: it starts 0.48 m away from the vehicle" in flight.component.flight.flight_state.message


def test_the_steps_in_which_a_law_has_failed_are_in_the_diagnostics():
    flight = Flight(params=parameters(type="nmpc"))
    said = []
    flight.component.diagnostics.receivers.append(said.append)
    flight.component.flight.law.failures = 3
    flight.step(1.0)
    assert said[-1].values["law_failures"] == 3
