"""Vehicles that take body rates or attitudes with thrust: the controller's inverse of their loop, the simulator's own loop, and flights."""

from dataclasses import replace

import numpy as np
import pytest
from closed_loop.plant import Plant
from hypothesis import given, settings
from hypothesis import strategies as st
from perch_control.controller import Controller
from perch_control.inner_loop import InnerLoopEstimate, rotors_at_rest
from perch_control.parameters import ControllerParameters
from perch_control.rotor_lag import RotorEstimate
from perch_core.errors import ConfigError
from perch_core.values import AttitudeThrust, ImuSample, MotorCommand, OdometryState, RatesThrust
from perch_core.vehicle import Actuation, load_vehicle
from perch_eval.in_process import fly
from perch_planner.problem import Limits, PerchSettings
from perch_sim.inner_loop import mixed, rates_of_attitude
from perch_sim.parameters import VehicleParameters
from perch_sim.scenario import load_scenario
from perch_sim.simulated_vehicle import SimulatedVehicle
from perch_sim.simulation import Simulation
from scipy.spatial.transform import Rotation

VEHICLE = load_vehicle("snapdragon_rates")
HOVER = float(np.sqrt(VEHICLE.hover_thrust / 4.0 / VEHICLE.thrust_coefficient))
STEP, SECOND = 2_000_000, 1_000_000_000
SCENARIO = replace(load_scenario("surface_90"), vehicle="snapdragon_rates")
numbers = st.floats(-1.0, 1.0)


def attitude_file(folder):
    """The same vehicle with an attitude loop in front of its rate loop."""
    file = folder / "attitude.yaml"
    file.write_text("extends: snapdragon_rates\nname: snapdragon_attitude\nactuation: {type: attitude_and_thrust}\n")
    return file


# -- the controller's side -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("delay, gain", [(0.0, 1.0), (0.004, 1.0), (0.01, 0.8)])
def test_a_loop_is_asked_for_what_the_rotors_would_do(delay, gain):
    """Rotors with their lag, and a loop of first order that is late: rates and thrust are the same, but for the delay."""
    actuation = Actuation(type="rates_and_thrust", delay=delay, rate_lag=(0.03, 0.025, 0.06), rate_gain=(gain,) * 3, thrust_lag=0.04,
                          thrust_gain=1 / gain)
    vehicle, h = replace(VEHICLE, actuation=actuation), 0.002
    plant, estimate = Plant(vehicle, p=np.array([0.0, 0.0, 5.0])), rotors_at_rest(vehicle).turning(HOVER)
    w, T, late = np.zeros(3), vehicle.hover_thrust, round(delay / h)
    queue, rotors, loop = [(np.zeros(3), T)] * late, [], []
    for k in range(200):
        command = HOVER + np.array([[120, -60, -90, 60], [200, -200, 200, -200], [-150] * 4]).T @ np.sin(np.array([12, 9, 5]) * h * k)
        state = (*plant.p, *plant.v, 0.0, 0.0, 0.0, 1.0, *w)
        estimate = estimate.after(h, vehicle.motor_time_constant).following(tuple(command),
                                                                            estimate.ahead(tuple(map(float, state)), vehicle), vehicle)
        queue.append((gain * np.array(estimate.sent.w_B), vehicle.mass * estimate.sent.thrust / gain))
        wanted, thrust = queue.pop(0)
        w = wanted + (w - wanted) * np.exp(-h / np.array(actuation.rate_lag))
        T = thrust + (T - thrust) * np.exp(-h / actuation.thrust_lag)
        plant.advance(command)
        rotors.append((*plant.w, vehicle.thrust_coefficient * np.sum(plant.speed**2)))
        loop.append((*w, T))
    rotors, loop = np.array(rotors)[: 200 - late], np.array(loop)[late:]
    swing = np.ptp(rotors, axis=0)
    assert (swing > (1.0, 1.0, 0.1, 0.5)).all()
    assert (np.abs(loop - rotors).max(axis=0) < 0.08 * swing).all(), np.abs(loop - rotors).max(axis=0) / swing


def test_commands_keep_to_the_loops_limits():
    estimate = rotors_at_rest(VEHICLE).turning(HOVER).following((VEHICLE.speed_max, VEHICLE.speed_min) * 2, (0.0,) * 9 + (1.0, 40.0, -40.0, 0.0),
                                                         VEHICLE)
    assert estimate.sent.w_B[:2] == (VEHICLE.actuation.rate_max, -VEHICLE.actuation.rate_max), "which such a turn takes in full"
    assert 0.0 < abs(estimate.sent.w_B[2]) < VEHICLE.actuation.rate_max
    assert 0.0 < estimate.sent.thrust < 4 * VEHICLE.thrust_max / VEHICLE.mass
    slow = replace(VEHICLE, actuation=replace(VEHICLE.actuation, thrust_lag=0.5))  # whose thrust has to be asked for far beyond itself
    for speed, thrust in ((VEHICLE.speed_max, 4 * VEHICLE.thrust_max / VEHICLE.mass), (VEHICLE.speed_min, 0.0)):
        estimate = rotors_at_rest(slow).turning(HOVER).following((speed,) * 4, (0.0,) * 9 + (1.0, 0.0, 0.0, 0.0), slow)
        assert estimate.sent.thrust == pytest.approx(thrust)


@settings(max_examples=50)
@given(st.lists(numbers, min_size=10, max_size=10))
def test_an_attitude_is_that_at_which_its_loop_asks_for_the_rates(x):
    vehicle = replace(VEHICLE, actuation=replace(VEHICLE.actuation, type="attitude_and_thrust"))
    q = Rotation.from_rotvec(3.0 * np.array(x[:3])).as_quat()
    speeds = tuple(HOVER + 60.0 * np.array(x[3:7]))
    state, w_C = (0.0,) * 6 + (*q, *x[7:10]), tuple(2.0 * np.array(x[4:7]))
    rates = rotors_at_rest(VEHICLE).turning(HOVER).following(speeds, state, VEHICLE).sent
    sent = rotors_at_rest(vehicle).turning(HOVER).following(speeds, state, vehicle, w_C).sent
    assert sent.w_B == w_C and sent.thrust == rates.thrust
    np.testing.assert_allclose(rates_of_attitude(q, np.array(sent.q_WB), np.array(w_C), vehicle.actuation.attitude_lag), rates.w_B,
                               atol=1e-9)


def test_rotors_without_a_loop_are_what_they_were():
    assert isinstance(rotors_at_rest(load_vehicle("snapdragon")), RotorEstimate) and isinstance(rotors_at_rest(VEHICLE), InnerLoopEstimate)


@pytest.mark.parametrize("attitude", [False, True])
def test_the_controller_speaks_the_vehicles_language_alone(attitude, tmp_path):
    name = str(attitude_file(tmp_path)) if attitude else "snapdragon_rates"
    component = Controller(ControllerParameters(vehicle=name))
    out = {port: [] for port in ("motor_command", "rates_thrust", "attitude_thrust")}
    for port, values in out.items():
        getattr(component, port).receivers.append(values.append)
    zero = np.zeros((6, 6))
    for k in range(3):
        component.on_odometry(OdometryState(SECOND + k * STEP, (0.0,) * 3, (0.0, 0.0, 0.0, 1.0), (0.0,) * 3, (0.0,) * 3, zero, zero))
    mine = out.pop("attitude_thrust" if attitude else "rates_thrust")
    assert [command.stamp for command in mine] == [SECOND + k * STEP for k in range(3)] and not mine[-1].armed
    assert not any(out.values())


# -- the simulator's side --------------------------------------------------------------------------------------------


@settings(max_examples=200)
@given(st.floats(0.0, 6.0), st.tuples(numbers, numbers, numbers), st.sampled_from([0.003, 0.05, 0.3]))
def test_the_mixer_keeps_the_rotors_limits_and_the_direction_of_tilt(thrust, shape, size):
    A, low, high = VEHICLE.allocation, VEHICLE.thrust_min, VEHICLE.thrust_max
    moment = size * np.array(shape) * (1.0, 1.0, 0.1)
    f = mixed(thrust, moment, np.linalg.inv(A), low, high)
    assert low <= f.min() and f.max() <= high
    free = np.linalg.solve(A, [thrust, *moment])
    if low <= free.min() and free.max() <= high:
        np.testing.assert_allclose(f, free, atol=1e-12)
    got = (A @ f)[1:3]
    assert abs(got[0] * moment[1] - got[1] * moment[0]) < 1e-9 and got @ moment[:2] >= -1e-12


@settings(max_examples=100)
@given(st.lists(numbers, min_size=9, max_size=9), st.floats(0.02, 0.5))
def test_an_attitude_loop_turns_the_short_way(x, lag):
    now, error, rates = Rotation.from_rotvec(3.0 * np.array(x[:3])), 1.7 * np.array(x[3:6]), np.array(x[6:9])
    wanted = (now * Rotation.from_rotvec(error)).as_quat()
    for sign in (1.0, -1.0):
        np.testing.assert_allclose(rates_of_attitude(now.as_quat(), sign * wanted, rates, lag), rates + error / lag, atol=1e-7)


@pytest.mark.parametrize("axis, factor", [(0, 1.0), (1, 1.0), (2, 1.0), (3, 1.0), (0, 1.5)])
def test_the_loop_follows_a_step_with_its_lag(axis, factor):
    a = VEHICLE.actuation
    scenario = replace(SCENARIO, disturbance=replace(SCENARIO.disturbance, loop_lag_factor=factor))
    simulation = Simulation(scenario, 1)
    simulation.plant.place((0.0, 0.0, 2.0), (0.0, 0.0, 0.0, 1.0), np.zeros(3), np.zeros(3), np.full(4, HOVER))
    step, hover = np.eye(4)[axis] * (1.0, 1.0, 0.3, 1.0), np.array([0.0, 0.0, 0.0, 9.81])
    simulation.loop.command(simulation.time - round(1e9 * a.delay), True, hover[:3], hover[3])
    seen = []
    for _ in range(60):
        *rates, thrust = hover + step
        simulation.loop.command(simulation.time, True, rates, thrust)
        simulation.motors.command(simulation.time, True, simulation.plant.rotor_speed)
        simulation.advance()
        seen.append((*simulation.state.x[10:13], simulation.plant.rotor_thrust.sum() / VEHICLE.mass))
    t, lag = 0.002 * np.arange(1, 61) - a.delay, factor * (*a.rate_lag, a.thrust_lag)[axis]
    expected = np.where(t > 0.0, 1.0 - np.exp(-np.maximum(t, 0.0) / lag), 0.0)
    done = (np.array(seen) - hover)[:, axis] / step[axis]
    assert np.abs(done - expected).max() < 0.12, "the rotors need a few periods for the moment of a step"
    assert np.abs(done - expected)[-20:].max() < 0.03


@pytest.mark.parametrize("vehicle, change", [("snapdragon", {"loop_lag_factor": 0.6}), ("snapdragon", {"voltage_factor": 0.9}),
                                             ("snapdragon_rates", {"voltage_factor": 0.9}), ("betaflight", {"loop_lag_factor": 1.2})])
def test_a_disturbance_without_effect_on_the_vehicle_is_refused(vehicle, change):
    scenario = replace(SCENARIO, vehicle=vehicle, disturbance=replace(SCENARIO.disturbance, **change))
    with pytest.raises(ConfigError, match=f"disturbance.{next(iter(change))}: .* has no effect on {vehicle}"):
        Simulation(scenario, 1)


def said(vehicle):
    """What the simulated vehicle complains of."""
    lines = []
    vehicle.log.receivers.append(lambda line: lines.append(line.text) if line.level == "error" else None)
    return lines


def test_the_vehicle_takes_its_own_kind_of_command_alone():
    vehicle = SimulatedVehicle(VehicleParameters(cameras="none"), SCENARIO)
    lines = said(vehicle)
    vehicle.on_motor_command(MotorCommand(vehicle.time, True, (HOVER,) * 4))
    vehicle.on_attitude_thrust(AttitudeThrust(vehicle.time, True, (0.0, 0.0, 0.0, 1.0), (0.0,) * 3, 9.81))
    assert lines == [f"snapdragon_rates takes rates_and_thrust, not {kind}: ignored" for kind in ("rotor_speeds", "attitude_and_thrust")]
    vehicle.advance()
    assert vehicle.simulation.plant.rotor_speed.max() == 0.0


def test_a_vehicle_whose_commands_cease_names_their_topic():
    flown, reports = SimulatedVehicle(VehicleParameters(cameras="none", vehicle="snapdragon_rates")), []
    flown.diagnostics.receivers.append(reports.append)
    flown.advance(), flown.on_rates_thrust(RatesThrust(flown.time, True, (0.0, 0.0, 0.0), 9.81))
    for _ in range(60):
        flown.advance()
    flown.diagnose()
    assert reports[-1].message == "motors stopped: no rates_thrust_command"


def test_nonsense_is_refused_but_stops_the_motors_where_it_disarms():
    vehicle = SimulatedVehicle(VehicleParameters(cameras="none"), SCENARIO)
    lines = said(vehicle)
    for _ in range(100):
        vehicle.on_rates_thrust(RatesThrust(vehicle.time, True, (0.0,) * 3, 5.0))
        vehicle.advance()
    vehicle.on_rates_thrust(RatesThrust(vehicle.time, True, (np.nan, 0.0, 0.0), 5.0))
    vehicle.advance()
    assert lines == ["rates_and_thrust: w_B: nan is not finite"] and vehicle.simulation.plant.rotor_speed.min() > 500.0
    for _ in range(200):
        vehicle.on_rates_thrust(RatesThrust(vehicle.time, False, (np.nan,) * 3, np.nan))
        vehicle.advance()
    assert vehicle.simulation.plant.rotor_speed.max() < 50.0


# -- the file, and flights -------------------------------------------------------------------------------------------


def test_the_planner_plans_for_the_rotors_below():
    assert Limits.of(PerchSettings(), VEHICLE) == Limits.of(PerchSettings(), load_vehicle("snapdragon"))


def test_a_vehicle_takes_over_what_it_does_not_say_itself(tmp_path):
    vehicle = load_vehicle(attitude_file(tmp_path))
    assert vehicle.actuation == replace(VEHICLE.actuation, type="attitude_and_thrust")
    assert vehicle.inertia == load_vehicle("snapdragon").inertia
    (tmp_path / "odd.yaml").write_text("extends: snapdragon\nactuation: {type: thoughts}\n")
    with pytest.raises(ConfigError, match="thoughts"):
        load_vehicle(tmp_path / "odd.yaml")
    (tmp_path / "lost.yaml").write_text("extends: nowhere\n")
    with pytest.raises(ConfigError, match="vehicles: nowhere: unknown"):
        load_vehicle(tmp_path / "lost.yaml")


@pytest.mark.parametrize("attitude", [False, True])
def test_it_perches_on_a_wall(attitude, tmp_path):
    scenario = replace(SCENARIO, vehicle=str(attitude_file(tmp_path))) if attitude else SCENARIO
    trace = fly(scenario, 1)
    assert trace.outcome == "perched", trace.message
    assert not trace.values("motor_command") and len(trace.values("attitude_thrust_command" if attitude else "rates_thrust_command")) > 2500
    assert isinstance(trace.values("imu/data_raw")[0], ImuSample) and np.degrees(trace.contacts[-1].tilt_error) < 10.0
