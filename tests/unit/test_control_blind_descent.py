"""The descent without position ends on the ground, whatever thrust, mass, vibration and timeout are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from closed_loop.plant import Disturbances
from perch_control import supervisor
from perch_control.descent import BlindDescent
from perch_control.flight_settings import FlightSettings
from perch_control.modes import State
from perch_core.values import Command
from perch_core.vehicle import ControlGains, load_vehicle
from unit.controller_flight import Flight, hovering, parameters

LEVEL, ZERO = (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 0.0)


def lands(flight, **odometry) -> None:
    for _ in range(40):
        flight.step(0.1, **odometry)
        if not flight.motors[-1].armed:
            break
    assert flight.state is State.DISARMED and flight.plant.p[2] < 0.02 and flight.plant.impact_speed < 1.5


@pytest.mark.parametrize("disturbances", [Disturbances(rotor_factor=(1.06,) * 4), Disturbances(mass_factor=0.95)])
def test_a_thrust_that_is_not_the_files_is_not_taken_for_the_ground(disturbances):
    lands(Flight(disturbances=disturbances).take_off(), odometry=False)


def test_vibration_is_not_taken_for_the_ground():
    flight, rng = hovering(), np.random.default_rng(0)
    felt = flight.imu

    def shaken():
        sample = felt()
        return sample._replace(w_B=tuple(np.add(sample.w_B, 0.01 * rng.standard_normal(3))), f_B=tuple(np.add(sample.f_B, 3.0 * rng.standard_normal(3))))

    flight.imu = shaken
    lands(flight, odometry=False)


def test_a_late_begin_lands_on_the_ground():
    flight = Flight(params=replace(parameters(), flight=FlightSettings(odometry_timeout=0.25))).take_off()
    lands(flight, p_WB=(float("nan"),) * 3)


def test_what_was_felt_before_the_descent_is_no_rest():
    x = BlindDescent(load_vehicle("snapdragon"), ControlGains(), LEVEL, ZERO, 0.0, 1.0)
    for k in range(500):
        x.imu(0.002 * k, ZERO, (0.0, 0.0, 9.81))
    assert not x.landed
    for k in range(500, 820):
        x.imu(0.002 * k, ZERO, (0.0, 0.0, 9.81))
    assert x.landed, "rest after the descent has begun is the ground"


def test_a_landing_that_odometry_does_not_show_is_ended_by_the_imu(monkeypatch):
    flight, climbing = hovering(), (0.0, 0.0, 0.3)
    flight.order(Command.LAND)
    flight.step(5.0, v_B=climbing)
    assert flight.state is State.LANDING and flight.plant.p[2] < 0.02, "at rest on the ground, and odometry says that it climbs"
    monkeypatch.setattr(supervisor.Supervisor, "longest_landing", 1.4)
    lands(flight, v_B=climbing)
    assert "descent without position: the landing has taken too long" in flight.said and "landed without position" in flight.said


def test_a_descent_that_never_meets_the_ground_stops_the_motors(monkeypatch):
    monkeypatch.setattr(supervisor.Supervisor, "longest_landing", 1.0)
    flight = hovering()
    felt = flight.imu
    flight.imu = lambda: felt()._replace(w_B=ZERO, f_B=(0.0, 0.0, 8.9))
    flight.step(0.9, odometry=False)
    assert flight.state is State.LANDING and flight.motors[-1].armed
    flight.step(0.4, odometry=False)
    assert flight.state is State.FAILED and not flight.motors[-1].armed and "no ground contact within 1 s, motors off" in flight.said


def test_a_jump_of_the_stamps_does_not_age_a_descent():
    x = BlindDescent(load_vehicle("snapdragon"), ControlGains(), LEVEL, ZERO, 0.0, 0.0)
    x.imu(1000.0, ZERO, (0.0, 0.0, 9.1))
    assert x.age < 0.1
