"""The plant's kernels against plain numpy, conservation laws and closed forms."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.rigid_body import accelerations
from perch_core import so3
from perch_core.vehicle import GRAVITY, load_vehicle
from perch_sim.body import make_body
from perch_sim.contact import FREE
from perch_sim.dynamics import advance, derivative, lagged
from perch_sim.obstacles import make_obstacles
from perch_sim.scenario import Disturbance, load_scenario

SURFACES = make_obstacles(load_scenario("surface_90")).surfaces
UNIT = st.floats(-1.0, 1.0)
VECTOR = st.tuples(UNIT, UNIT, UNIT).map(np.array)
NO_WIND, HIGH_UP = np.zeros(3), np.array([0.0, 0.0, 2.0])


def vehicle_without_drag(name: str = "snapdragon"):
    return dataclasses.replace(load_vehicle(name), drag=(0.0, 0.0, 0.0))


def fly(x, speeds, command, body, step, steps):
    x, speeds, sample = x.copy(), np.array(speeds, float), np.zeros(6)
    for k in range(steps):
        advance(x, speeds, np.array(command, float), NO_WIND, body, SURFACES, FREE, k * step, step, sample)
    return x, speeds, sample


def state(p=HIGH_UP, phi=(0, 0, 0), v=(0, 0, 0), w=(0, 0, 0)):
    return np.concatenate([p, so3.quat_exp(np.array(phi, float)), v, w]).astype(float)


@given(phi=VECTOR, v=VECTOR, w=VECTOR, wind=VECTOR, share=st.tuples(*[st.floats(0.0, 1.0)] * 4),
       name=st.sampled_from(["snapdragon", "rpg"]))
def test_accelerations_are_those_of_newton_and_euler(phi, v, w, wind, share, name):
    """The plant has rotor arms of its own. [tests P:eq2]"""
    vehicle = load_vehicle(name)
    speeds = vehicle.speed_max * np.array(share)
    x, out = state(phi=3 * phi, v=5 * v, w=10 * w), np.zeros(13)
    derivative(x, speeds, wind, make_body(vehicle), SURFACES, FREE, 0.0, out)
    R_WB = so3.quat_to_matrix(x[3:7])
    drag_B = -np.array(vehicle.drag) * (R_WB.T @ (5 * v - wind))
    a_W, dw_B = accelerations(vehicle, R_WB, 10 * w, vehicle.thrust_coefficient * speeds**2, drag_B)
    np.testing.assert_allclose(out[:3], 5 * v, atol=1e-12)
    np.testing.assert_allclose(out[7:10], a_W, atol=1e-9)
    np.testing.assert_allclose(out[10:13], dw_B, rtol=1e-9, atol=1e-6)


@given(phi=VECTOR, w=VECTOR)
def test_quaternion_rate_is_that_of_the_rotation(phi, w):
    x, out = state(phi=3 * phi, w=10 * w), np.zeros(13)
    derivative(x, np.zeros(4), NO_WIND, make_body(load_vehicle("snapdragon")), SURFACES, FREE, 0.0, out)
    h = 1e-6
    ahead = so3.quat_multiply(x[3:7], so3.quat_exp(10 * w * h))
    behind = so3.quat_multiply(x[3:7], so3.quat_exp(-10 * w * h))
    np.testing.assert_allclose(out[3:7], (ahead - behind) / (2 * h), atol=1e-7)


def test_free_fall_is_a_parabola():
    body = make_body(vehicle_without_drag())
    x, _, sample = fly(state(p=[0, 0, 3], v=[1, 0.5, 0]), np.zeros(4), np.zeros(4), body, 5e-4, 1000)
    np.testing.assert_allclose(x[:3], [0.5, 0.25, 3 - 0.5 * GRAVITY * 0.25], atol=1e-12)
    np.testing.assert_allclose(sample[:3], 0.0, atol=1e-9)  # an accelerometer in free fall reads nothing


@settings(max_examples=25)
@given(phi=VECTOR, w=VECTOR)
def test_tumbling_keeps_energy_and_angular_momentum(phi, w):
    vehicle = vehicle_without_drag()
    body, J = make_body(vehicle), np.array(vehicle.inertia)
    before = state(p=[0, 0, 3], phi=3 * phi, w=15 * w)
    after, _, _ = fly(before, np.zeros(4), np.zeros(4), body, 5e-4, 600)
    def momentum_W(x):
        return so3.quat_rotate(x[3:7], J * x[10:13])

    def energy(x):
        return 0.5 * vehicle.mass * x[7:10] @ x[7:10] + 0.5 * (J * x[10:13]) @ x[10:13] + vehicle.mass * GRAVITY * x[2]

    np.testing.assert_allclose(momentum_W(after), momentum_W(before), rtol=1e-6, atol=1e-11)
    assert energy(after) == pytest.approx(energy(before), rel=1e-9)
    assert np.linalg.norm(after[3:7]) == pytest.approx(1.0, abs=1e-12)


def test_hover_speeds_balance_the_weight():
    vehicle = load_vehicle("snapdragon")
    speed = np.full(4, np.sqrt(vehicle.hover_thrust / 4 / vehicle.thrust_coefficient))
    x, _, sample = fly(state(), speed, speed, make_body(vehicle), 5e-4, 2000)
    np.testing.assert_allclose(x, state(), atol=1e-9)
    np.testing.assert_allclose(sample, [0, 0, GRAVITY, 0, 0, 0], atol=1e-9)


def test_integration_is_of_the_fourth_order():
    """Halving the step divides the error by about sixteen, with lag, drag and rotation at work."""
    vehicle = load_vehicle("snapdragon")
    body, start, command = make_body(vehicle), state(v=[2, 1, 0], w=[3, -2, 5]), [1200, 1300, 1250, 1150]
    exact = fly(start, [600] * 4, command, body, 1e-4, 2000)[0]
    errors = [np.linalg.norm(fly(start, [600] * 4, command, body, h, round(0.2 / h))[0] - exact) for h in (8e-3, 4e-3)]
    assert 11.0 < errors[0] / errors[1] < 22.0


@given(start=st.floats(0.0, 1700.0), command=st.floats(0.0, 1700.0), age=st.floats(0.0, 0.5))
def test_rotor_lag_is_of_the_first_order(start, command, age):
    many = np.full(4, start)
    for _ in range(10):
        many = lagged(many, np.full(4, command), 0.05, age / 10)
    np.testing.assert_allclose(many, command + (start - command) * np.exp(-age / 0.05), rtol=1e-9, atol=1e-9)
    assert np.all(lagged(np.full(4, start), np.full(4, command), 0.0, 1e-3) == command)


def test_imu_off_the_centre_feels_the_rotation():
    """At r the specific force gains w x (w x r): a steady spin about z with r along x pulls towards -x."""
    vehicle = vehicle_without_drag()
    vehicle = dataclasses.replace(vehicle, imu=dataclasses.replace(vehicle.imu, position=(0.1, 0.0, 0.0)))
    _, _, sample = fly(state(w=[0, 0, 6.0]), np.zeros(4), np.zeros(4), make_body(vehicle), 5e-4, 1)
    np.testing.assert_allclose(sample, [-0.1 * 36.0, 0, 0, 0, 0, 6.0], atol=1e-9)


def test_disturbances_change_what_they_name():
    vehicle = load_vehicle("snapdragon")
    nominal = make_body(vehicle)
    other = make_body(vehicle, Disturbance(mass_factor=1.2, inertia_factor=0.9, motor_lag_factor=2.0,
                                           rotor_thrust_factor=(1.0, 0.8, 1.0, 1.0)))
    assert other.mass == pytest.approx(1.2 * nominal.mass)
    np.testing.assert_allclose(other.inertia, 0.9 * nominal.inertia)
    assert other.time_constant == pytest.approx(0.1)
    np.testing.assert_allclose(other.thrust_coefficient / nominal.thrust_coefficient, [1.0, 0.8, 1.0, 1.0])


def test_ground_effect_lifts_near_the_floor_only():
    """Cheeseman and Bennett: one rotor radius above ground 1 / (1 - 1/16) = 6.7 % more thrust."""
    vehicle = load_vehicle("snapdragon")
    body = make_body(vehicle, Disturbance(surface_effect=True))
    speed, out = np.full(4, 1268.0), np.zeros(13)
    plain = 4 * vehicle.thrust_coefficient * 1268.0**2 / vehicle.mass - GRAVITY

    def gain(height):
        derivative(state(p=[0, 0, height]), speed, NO_WIND, body, SURFACES, FREE, 0.0, out)
        return (out[9] + GRAVITY) / (plain + GRAVITY)

    assert gain(2.0) == pytest.approx(1.0, abs=1e-12)
    radius = vehicle.propeller_radius
    free = make_body(dataclasses.replace(vehicle, perch_offset=0.0), Disturbance(surface_effect=True))
    derivative(state(p=[0, 0, radius]), speed, NO_WIND, free, SURFACES, FREE, 0.0, out)
    assert (out[9] + GRAVITY) / (plain + GRAVITY) == pytest.approx(16 / 15, rel=1e-6)
