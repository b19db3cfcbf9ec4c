"""The controller as a component: any rate, silence, bad input, restart of time, nonsense on every port, laws and parameters."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from closed_loop.plant import Disturbances, Plant
from perch_control.controller import Controller
from perch_control.laws import LAWS
from perch_control.modes import State
from perch_control.parameters import ControllerChoice
from perch_core.errors import ConfigError, PerchError
from perch_core.jit import COMPILED, _Compiled
from perch_core.trajectory import FlatTrajectory, SampledTrajectory
from perch_core.values import (
    NANOSECONDS, AtEnd, Command, ControllerCommand, EstimatorHealth, MappedPowerline, PowerlineMap, SetControllerRequest,
    TrajectoryOrder, Transform, TriggerRequest, TriggerResponse)
from perch_core.vehicle import load_vehicle
from unit.controller_flight import START, Flight, hovering, parameters

# -- rates -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rate, law, adaptive", [(100.0, "geometric", False), (100.0, "nmpc", True), (333.0, "geometric", True),
                                                 (1000.0, "geometric", True), (1000.0, "nmpc", False)])
def test_every_odometry_sample_is_answered_and_flown_on_at_any_rate(rate, law, adaptive):
    flight = Flight(rate, parameters(type=law, adaptive=adaptive)).take_off()
    stamps = [m.stamp for m in flight.motors]
    assert stamps == list(range(START, flight.stamp, flight.period))
    flight.follow(flight.path(flight.plant.p, flight.plant.p + [1.0, 0.5, 0.2], 1.6), id=6)
    flight.step(2.4)
    assert flight.state is State.HOVERING and np.linalg.norm(flight.plant.v) < 0.05, flight.said
    np.testing.assert_allclose(flight.plant.p, [1.0, 0.5, 0.8], atol=0.03)
    assert flight.component.flight.law.period == pytest.approx(flight.period * 1e-9, rel=0.1)


@pytest.mark.parametrize("rate", [100.0, 333.0, 500.0])
def test_status_and_reference_keep_their_periods_of_stamps(rate):
    flight = Flight(rate).take_off()
    stamps = np.array([s.stamp for s in flight.status])
    due = START + 20_000_000 * np.arange(len(stamps))
    assert len(stamps) == pytest.approx((flight.stamp - START) / 20e6, abs=1.0)
    assert ((stamps - due >= 0) & (stamps - due < flight.period)).all(), "the first sample at or after each instant of the grid"
    gaps = np.diff([r.stamp for r in flight.references if r.trajectory_id == 5])
    assert np.median(gaps) == pytest.approx(10e6, abs=flight.period / 2 + 1)


def test_a_reference_that_nobody_wants_is_not_made():
    flight = Flight()
    flight.component.reference.receiver_check = lambda: False
    flight.take_off()
    assert not flight.references


def test_it_does_not_arm_before_a_vehicle_takes_the_commands():
    flight = Flight()
    listening = False
    flight.component.motor_command.receiver_check = lambda: listening
    flight.step(0.5)
    flight.order(Command.ARM)
    flight.step(0.1)
    assert flight.state is State.DISARMED and "arm is refused: no vehicle has subscribed to the commands yet" in flight.said
    assert not flight.motors[-1].armed
    listening = True
    flight.take_off()


@pytest.mark.skipif(not COMPILED, reason="nothing is compiled")
def test_a_step_in_hover_takes_few_calls_of_kernels(monkeypatch):
    """From the interpreter, a call takes microseconds, whatever the kernel computes; between kernels, it takes nothing."""
    flight, called = hovering(), []
    call = _Compiled.__call__
    monkeypatch.setattr(_Compiled, "__call__", lambda kernel, *arguments: (called.append(kernel.__name__), call(kernel, *arguments))[1])
    flight.step(0.1)
    assert 50 <= len(called) <= 9 * 50, called[-12:]


@pytest.mark.parametrize("command", [Command.DISARM, Command.ATTACHED])
@pytest.mark.parametrize("imu", [True, False])
def test_at_rest_it_does_not_arm_once_odometry_has_stopped(command, imu):
    flight = Flight()
    flight.step(0.5)
    flight.order(command)
    state = flight.state
    for k in range(50):
        flight.component.on_watchdog(77 * NANOSECONDS + k * 20_000_000)
        flight.step(0.02, odometry=False, imu=imu)
    flight.order(Command.ARM)
    flight.step(0.02, odometry=False, imu=imu)
    assert flight.state is state and "arm is refused: no usable odometry" in flight.said and not flight.motors[-1].armed
    flight.step(0.1)
    flight.order(Command.ARM)
    assert flight.state is (State.RECOVERING if command is Command.ATTACHED else State.ARMED), "odometry is back"


# -- silence -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rate", [100.0, 1000.0])
def test_where_odometry_stops_the_imu_is_answered_down_to_the_ground(rate):
    flight = Flight(rate).take_off()
    last = flight.motors[-1].stamp
    flight.step(0.2, odometry=False)
    first = next(m.stamp for m in flight.motors if m.stamp > last)
    assert first - last == pytest.approx(80e6, abs=flight.period), "before the motors stop by themselves, after 0.1 s"
    assert flight.state is State.LANDING and "odometry has stopped" in flight.said
    assert flight.status[-1].stamp > first, "the status goes on"
    flight.step(6.0, odometry=False)
    assert flight.state is State.DISARMED and flight.plant.p[2] < 0.02 and flight.plant.impact_speed < 1.5
    count = len(flight.motors)
    flight.step(0.5, odometry=False)
    assert len(flight.motors) == count, "disarmed, silence needs no answer"


def test_an_imu_that_is_alone_before_the_first_odometry_is_not_answered():
    flight = Flight()
    flight.command = None
    for _ in range(200):
        flight.component.on_imu(flight.imu())
        flight.stamp += flight.period
    assert not flight.motors


def test_where_both_stop_the_watchdog_goes_on_by_the_clock():
    flight = hovering()
    clock, last, count = 77 * NANOSECONDS, flight.motors[-1].stamp, len(flight.motors)
    for _ in range(4):  # 60 ms after the wake that saw the last input
        flight.component.on_watchdog(clock)
        clock += 20_000_000
    assert len(flight.motors) == count
    for _ in range(10):
        flight.component.on_watchdog(clock)
        clock += 20_000_000
    answered = [m.stamp for m in flight.motors[count:]]
    assert len(answered) == 10 and (np.diff(answered) == 20_000_000).all() and answered[0] - last == 80_000_000
    assert flight.state is State.LANDING and "neither odometry nor IMU" in flight.said and flight.motors[-1].armed
    assert all(isinstance(m.stamp, int) for m in flight.motors)
    flight.stamp += 280_000_000
    flight.step(8.0, odometry=False)  # the IMU is back
    assert flight.state is State.DISARMED


def test_the_watchdog_is_quiet_while_inputs_come_and_while_disarmed():
    flight = Flight()
    for k in range(100):
        flight.component.on_watchdog(k * NANOSECONDS)
    assert not flight.motors
    flight.take_off()
    count = len(flight.motors)
    for k in range(100):  # simulation far slower than the clock: something has come between any two wakes
        flight.step(0.002)
        flight.component.on_watchdog(k * NANOSECONDS)
    assert len(flight.motors) == count + 100 and flight.state is State.HOVERING


# -- bad sensors -------------------------------------------------------------------------------------------------------


NAN = float("nan")


@pytest.mark.parametrize("changes", [
    {"p_WB": (NAN, 0.0, 0.0)}, {"v_B": (0.0, float("inf"), 0.0)}, {"q_WB": (0.0, 0.0, 0.0, 0.0)}, {"q_WB": (0.0, 0.0, 0.0, 0.4)},
    {"p_WB": (1e300, 0.0, 0.0)}, {"w_B": (0.0, 0.0, 1e200)}, {"pose_covariance": NAN * np.eye(6)}, {"twist_covariance": 1e300 * np.eye(6)}])
def test_odometry_that_cannot_be_used_is_answered_bridged_and_then_descended_without(changes):
    flight = hovering()
    count = len(flight.motors)
    flight.step(0.04, **changes)
    assert len(flight.motors) == count + 20 and flight.state is State.HOVERING
    assert [line.level for line in flight.lines if "refused" in line.text] == ["warning"]
    flight.step(0.04, **changes)
    assert len(flight.motors) == count + 40 and flight.state is State.LANDING


@pytest.mark.parametrize("variance, state", [(0.01, State.HOVERING), (1e4, State.LANDING)])
def test_odometry_that_jumps_and_does_not_know_where_it_is_is_not_followed(variance, state):
    flight = hovering()
    flight.step(0.1, p_WB=(1.0, 0.0, 0.6), pose_covariance=variance * np.eye(6))
    assert flight.state is state and "position jumped" in flight.said
    assert (flight.component.flight.flight_state.state_estimate[0] > 0.9) == (state is State.HOVERING)


def test_commands_go_on_in_the_order_of_their_stamps_where_those_of_odometry_step_back():
    """A vehicle ignores a command that is older than the one before."""
    flight = hovering()
    for _ in range(100):
        flight.step(0.002, stamp=flight.stamp - 500_000_000)
    stamps = [command.stamp for command in flight.motors]
    assert flight.state is State.LANDING and stamps == sorted(stamps)


def test_odometry_that_turns_over_in_flight_is_not_followed_but_a_new_heading_is():
    for q, state in (((1.0, 0.0, 0.0, 0.0), State.LANDING), ((0.0, 0.0, np.sin(0.3), np.cos(0.3)), State.HOVERING)):
        flight = hovering()
        flight.step(0.1, q_WB=q)
        assert flight.state is state and "attitude jumped" in flight.said


def test_odometry_that_turns_over_by_hand_on_the_ground_is_followed():
    flight = Flight()
    flight.step(0.1)
    flight.step(0.1, q_WB=(1.0, 0.0, 0.0, 0.0))
    assert not flight.component.flight.odometry_refusal


def test_a_jump_with_a_covariance_that_is_no_number_is_refused():
    flight = hovering()
    flight.step(0.004, pose_covariance=np.full((6, 6), NAN))
    flight.step(0.1, p_WB=(1.0, 0.0, 0.6), pose_covariance=np.diag([NAN] + [1e-4] * 5))
    assert flight.state is State.LANDING and "pose_covariance: an entry of nan is not finite" in flight.said


FLIPPED = (1.0, 0.0, 0.0, 0.0)  # forward, right, down in forward, left, up


def forward_right_down(sensors: str = "") -> Flight:
    """A flight whose IMU has the axes of aviation."""
    flight = Flight(params=replace(parameters(), sensors=sensors))
    flight.R_BI, flight.imu_frame = np.diag([1.0, -1.0, -1.0]), "fcu_imu"
    return flight


def test_an_imu_in_other_axes_is_turned_by_its_frame():
    flight = forward_right_down()
    flight.component.on_transform(Transform("base_link", "plate", (0.0, 0.0, 0.1), (0.0, 0.0, 0.0, 1.0)))
    flight.component.on_transform(Transform("plate", "fcu_imu", (0.0, 0.0, 0.0), FLIPPED))
    flight.take_off().step(1.0)
    assert flight.state is State.HOVERING and flight.component.flight.thrust_ratio == pytest.approx(1.0, abs=0.02)
    flight.step(6.0, odometry=False)
    assert flight.state is State.DISARMED and flight.plant.impact_speed < 1.5, "the descent without position feels the right way, too"


def test_an_imu_in_other_axes_is_turned_by_the_sensor_file(tmp_path):
    file = tmp_path / "mine.yaml"
    file.write_text("name: mine\nimu: {rate: 500, accel_noise_density: 0.01, gyro_noise_density: 0.001, accel_bias_walk: 0.001,\n"
                    "  gyro_bias_walk: 0.0001, orientation: [1.0, 0.0, 0.0, 0.0]}\n")
    flight = forward_right_down(str(file))
    flight.imu_frame = "imu_link"
    flight.take_off().step(1.0)
    assert flight.state is State.HOVERING and flight.component.flight.thrust_ratio == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("frame, said", [("fcu_imu", "no usable IMU samples"), ("imu_link", "-9.8 m/s^2 along b3 at rest")])
def test_it_does_not_arm_where_the_axes_of_the_imu_are_not_known_or_wrong(frame, said):
    flight = forward_right_down()
    flight.imu_frame = frame
    flight.step(0.5)
    flight.order(Command.ARM)
    flight.step(0.1)
    assert flight.state is State.DISARMED and said in flight.said and not flight.motors[-1].armed
    assert ("/tf_static" in flight.said) == (frame == "fcu_imu")


def test_odometry_in_another_frame_is_ignored():
    flight = hovering()
    count = len(flight.motors)
    flight.component.on_odometry(flight.odometry(frame="odom"))
    assert len(flight.motors) == count and "'odom'" in flight.said


@pytest.mark.parametrize("offset", [-2000 * NANOSECONDS, -2 * NANOSECONDS, 2 * NANOSECONDS, 10**18])
def test_stamps_of_another_time_are_ignored_however_many_come_between(offset):
    flight = hovering()
    for _ in range(300):
        flight.step(0.002)
        for _ in range(3):
            flight.component.on_odometry(flight.odometry(stamp=flight.stamp + offset))
            flight.component.on_imu(flight.imu(stamp=flight.stamp + offset))
    assert flight.state is State.HOVERING and "not current" in flight.said
    assert max(m.stamp for m in flight.motors) < flight.stamp
    np.testing.assert_allclose(flight.plant.p, [0, 0, 0.6], atol=0.03)


def test_after_a_jump_of_time_samples_in_bursts_are_answered_by_a_descent():
    """As from a driver that reads a FIFO: the first odometry of a burst is older than the last IMU sample of it."""
    flight = hovering()
    flight.stamp += 10 * NANOSECONDS
    for _ in range(20):
        stamps = range(flight.stamp, flight.stamp + 5 * flight.period, flight.period)
        for stamp in stamps:
            flight.component.on_imu(flight.imu(stamp=stamp))
        for stamp in stamps:
            flight.component.on_odometry(flight.odometry(stamp=stamp))
        flight.stamp = stamps.stop
    assert flight.state is State.LANDING and "time has jumped ahead" in flight.said
    assert flight.motors[-1].stamp == flight.stamp - flight.period and flight.motors[-1].armed


def test_a_little_older_stamps_are_refused_by_the_flight_and_move_nothing():
    flight = hovering()
    for _ in range(50):
        flight.step(0.002)
        flight.component.on_odometry(flight.odometry(stamp=flight.stamp - 300_000_000))
    assert flight.state is State.HOVERING
    np.testing.assert_allclose(flight.plant.p, [0, 0, 0.6], atol=0.03)


@pytest.mark.parametrize("back", [60_000_000, 150_000_000, 300_000_000, 900_000_000])
def test_where_the_clock_is_set_back_the_flight_goes_on(back):
    flight = hovering()
    flight.follow(flight.path(flight.plant.p, (1.0, 0.0, 0.6), 1.6), id=6)
    flight.step(0.8)
    flight.stamp -= back
    flight.step(0.1)
    assert flight.state is State.TRACKING and ("time has been set back" in flight.said) == (back > 80_000_000)
    assert flight.motors[-1].armed and flight.motors[-1].stamp >= flight.motors[-2].stamp, "a vehicle ignores a command older than the one before"
    assert 0 <= flight.stamp - flight.status[-1].stamp <= 22_000_000
    flight.step(1.4)
    assert flight.state is State.HOVERING
    np.testing.assert_allclose(flight.plant.p, [1.0, 0.0, 0.6], atol=0.03)
    flight.follow(flight.path(flight.plant.p, (0.0, 0.0, 0.6), 1.6), id=7)
    flight.step(2.0)
    assert flight.state is State.HOVERING and "trajectory 7 refused" not in flight.said
    np.testing.assert_allclose(flight.plant.p, [0.0, 0.0, 0.6], atol=0.03)
    flight.order(Command.LAND, stamp=flight.stamp)
    flight.step(5.0)
    assert flight.state is State.DISARMED


@pytest.mark.parametrize("back", [150_000_000, 900_000_000])
def test_a_vehicle_on_its_perch_stays_attached_where_the_clock_is_set_back(back):
    flight = Flight()
    flight.step(0.5)
    flight.order(Command.ATTACHED)
    flight.stamp -= back
    flight.step(1.2)
    assert flight.state is State.ATTACHED and "restarted" not in flight.said


@pytest.mark.parametrize("back, odometry", [(2 * NANOSECONDS, True), (2 * NANOSECONDS, False), (300_000_000, False)])
def test_where_the_clock_is_set_back_far_or_odometry_stops_then_the_vehicle_descends_with_its_motors_on(back, odometry):
    flight = hovering()
    flight.stamp -= back
    for k in range(60):  # 1.2 s
        flight.step(0.02, odometry=odometry)
        flight.component.on_watchdog(77 * NANOSECONDS + k * 20_000_000)
        assert flight.motors[-1].armed
    assert flight.state is State.LANDING and "time has been set back" in flight.said
    flight.step(6.0, odometry=odometry)
    assert flight.state is State.DISARMED and flight.plant.p[2] < 0.02 and flight.plant.impact_speed < 1.5


@pytest.mark.parametrize("late, state", [(70_000_000, State.HOVERING), (100_000_000, State.LANDING), (200_000_000, State.LANDING)])
def test_odometry_far_behind_the_imu_is_not_flown_on(late, state):
    flight, waiting = hovering(), []
    for k in range(2 * late // flight.period + 50):  # it falls behind, as every other sample is late by one more
        waiting.append(flight.odometry())
        flight.step(0.002, odometry=False)
        if waiting[0].stamp < flight.stamp - late or k % 2:
            flight.component.on_odometry(waiting.pop(0))
    assert flight.state is state and ("behind the newest stamp: late" in flight.said) == (late > 80_000_000)
    assert flight.motors[-1].armed


@pytest.mark.parametrize("changes", [{"f_B": (NAN, 0.0, 9.8)}, {"w_B": (1e300, 0.0, 0.0)}, {"frame": "camera_down_optical_frame"}])
def test_imu_samples_that_cannot_be_used_are_ignored(changes):
    flight = hovering()
    ratio = flight.component.flight.health.ratio
    for _ in range(50):
        flight.component.on_imu(flight.imu(**changes))
        flight.step(0.002)
    assert flight.state is State.HOVERING and "imu/data_raw" in flight.said
    assert flight.component.flight.health.ratio == pytest.approx(ratio, abs=0.02)


def test_a_vehicle_that_was_started_again_is_answered_again():
    flight = hovering()
    flight.order(Command.LAND)
    flight.step(5.0)
    assert flight.state is State.DISARMED
    flight.stamp, flight.plant = 5_000_000, Plant(load_vehicle("snapdragon"), np.zeros(3), speed=np.zeros(4))
    count, begun = len(flight.status), []
    flight.component.flight.law.begin = lambda: begun.append("what was remembered does not count")
    flight.step(0.5)
    assert flight.motors[-1].stamp == flight.stamp - flight.period and "time has restarted" in flight.said and begun
    assert flight.status[-1].stamp < NANOSECONDS and len(flight.status) > count + 15
    flight.order(Command.ARM)
    flight.follow(flight.path((0, 0, 0), (0, 0, 0.5), 1.0))
    flight.step(1.5)
    assert flight.plant.p[2] == pytest.approx(0.5, abs=0.03)


def test_a_vehicle_that_was_killed_in_flight_and_started_again_is_answered_again():
    flight = hovering()
    for k in range(100):
        flight.component.on_watchdog(k * 20_000_000)
    assert flight.state is State.FAILED and "neither odometry nor IMU" in flight.said
    flight.stamp, flight.plant = 5_000_000, Plant(load_vehicle("snapdragon"), np.zeros(3), speed=np.zeros(4))
    flight.step(0.5)
    assert flight.state is State.DISARMED and flight.motors[-1].stamp == flight.stamp - flight.period


# -- nonsense in orders ------------------------------------------------------------------------------------------------


def samples(flight: Flight, **changes) -> SampledTrajectory:
    """A hover at the present place, as samples."""
    n = 40
    zero, thrust = np.zeros((n, 3)), np.full((n, 4), flight.component.flight.vehicle.hover_thrust / 4)
    fields = {"times": np.linspace(0.0, 1.0, n), "p": np.tile([0.0, 0.0, 0.6], (n, 1)), "q": np.tile([0.0, 0.0, 0.0, 1.0], (n, 1)), "v": zero,
              "w": zero, "a": zero, "dw": zero, "rotor_thrust": thrust}
    return SampledTrajectory(**fields | changes, start_time=flight.stamp * 1e-9 + 0.02)


def with_rates(flight):
    return samples(flight, w=np.full((40, 3), 1e9))


def many_coefficients(flight):
    c = np.zeros((1, 4, 1100))
    c[:, 2] = 0.6
    return FlatTrajectory(np.array([2.0]), c, flight.stamp * 1e-9 + 0.02)


def far_away(flight):
    t = flight.path((0, 0, 0.6), (1, 0, 0.6), 2.0)
    return FlatTrajectory(t.durations, t.coefficients + np.array([1e300, 0, 0, 0])[None, :, None], t.start_time)


def in_no_time(flight):
    t = flight.path((0, 0, 0.6), (1, 0, 0.6), 2.0)
    return FlatTrajectory(t.durations * 1e-7, t.coefficients, t.start_time)


def too_long(flight):
    return replace(flight.path((0, 0, 0.6), (1, 0, 0.6), 2.0), durations=np.array([1e7]))


@pytest.mark.parametrize("make, changes, word", [
    (None, {"contact_time": NAN}, "contact_time"), (None, {"contact_time": -1.0}, "contact_time"), (None, {"recovery_start": NAN}, "recovery_start"),
    (None, {"recovery_start": 1e9}, "recovery_start"), (None, {"at_end": 9}, "at_end: 9"), (None, {"id": -3}, "id: -3"),
    (many_coefficients, {}, "degree: 1099"), (with_rates, {}, "w: 1e+09"), (far_away, {}, "coefficients: 1e+300"), (in_no_time, {}, "durations"),
    (too_long, {}, "duration"), (lambda f: samples(f, q=np.tile([0.0, 0.0, 0.0, 0.9], (40, 1))), {}, "norm 0.9"),
    (lambda f: samples(f, rotor_thrust=np.full((40, 4), 1e6)), {}, "rotor_thrust"),
    (lambda f: samples(f, q=np.tile([1.0, 0.0, 0.0, 0.0], (40, 1))), {}, "by 19.6 m/s^2"),  # wxyz
    (lambda f: samples(f, rotor_thrust=2.2 * samples(f).rotor_thrust), {}, "by 11.8 m/s^2"),  # of other vehicles
    (lambda f: samples(f, rotor_thrust=0.4 * samples(f).rotor_thrust), {}, "by 5.9 m/s^2"),
    (lambda f: replace(f.path((0, 0, 0.6), (1, 0, 0.6), 2.0), start_time=NAN), {}, "start_time"),
    (lambda f: replace(f.path((0, 0, 0.6), (1, 0, 0.6), 2.0), start_time=1e12), {}, "start_time"),
    (lambda f: replace(f.path((0, 0, 0.6), (1, 0, 0.6), 2.0), start_time=-1e12), {}, "start_time"),
    (lambda f: replace(f.path((0, 0, 0.6), (1, 0, 0.6), 2.0), start_time=2.0**31 - 1.0), {}, "in the future"),
    (lambda f: replace(f.path((0, 0, 0.6), (1, 0, 0.6), 2.0), start_time=f.stamp * 1e-9 + 61.0), {}, "in the future"),
    (lambda f: replace(f.path((0, 0, 0.6), (1, 0, 0.6), 2.0), start_time=f.stamp * 1e-9 - 1.0), {}, "in the past"),
    (lambda f: f.path((2, 0, 0.6), (3, 0, 0.6), 2.0), {}, "away"),
])
def test_nonsense_on_trajectory_is_refused_and_said(make, changes, word):
    flight = hovering()
    trajectory = make(flight) if make else flight.path((0, 0, 0.6), (1, 0, 0.6), 2.0)
    flight.component.on_trajectory(TrajectoryOrder(99, trajectory)._replace(**changes))
    flight.step(0.3)
    assert flight.state is State.HOVERING
    assert "refused" in flight.status[-1].message and word in flight.status[-1].message and word in flight.said
    flight.component.on_recovery(TrajectoryOrder(99, trajectory)._replace(**changes))
    flight.step(0.1)
    assert flight.state is State.HOVERING
    np.testing.assert_allclose(flight.plant.p, [0, 0, 0.6], atol=0.03)


def test_a_way_out_of_another_time_is_refused():
    flight = hovering()
    trajectory = replace(samples(flight), start_time=flight.stamp * 1e-9 + 3600.0)
    flight.component.on_recovery(TrajectoryOrder(99, trajectory))
    assert "way out of trajectory 99 refused: it starts at" in flight.said


def test_samples_are_flown_by_their_normalised_quaternions():
    flight = hovering()
    q = np.tile([0.0, 0.0, 0.0, 1.0005], (40, 1))
    flight.follow(samples(flight, q=q), at_end=AtEnd.HOLD)
    flight.step(0.1)
    assert flight.state is State.TRACKING
    assert np.linalg.norm(flight.component.flight.flight_state.order.source.trajectory.q, axis=1) == pytest.approx(1.0, abs=1e-12)


def test_attached_before_any_odometry_is_refused():
    flight = Flight()
    flight.order(Command.ATTACHED)
    assert flight.state is State.DISARMED and "attached is refused: no usable odometry" in flight.said


@pytest.mark.parametrize("command, stamp, said", [(77, 0, "77"), (int(Command.DISARM), 0, "land first"), (int(Command.LAND), 1000, "too old")])
def test_commands_that_are_none_or_not_now_are_refused(command, stamp, said):
    flight = hovering()
    flight.component.on_command(ControllerCommand(stamp, command, "x" * 10_000))
    flight.step(0.2)
    assert flight.state is State.HOVERING and said in flight.said


@pytest.mark.parametrize("health, state", [
    (EstimatorHealth(0, 3, 0.0, 0, 0, 0.0, (0.0,) * 3, (0.0,) * 3, 0.0, 0.0, "of long ago"), State.HOVERING),
    (EstimatorHealth(-1, 9, 0.0, 0, 0, 0.0, (0.0,) * 3, (0.0,) * 3, 0.0, 0.0, "nonsense"), State.HOVERING),
    (EstimatorHealth(-1, 2, NAN, 0, 0, 0.0, (0.0,) * 3, (0.0,) * 3, 0.0, 0.0, ""), State.HOVERING),
    (EstimatorHealth(-1, 3, 0.0, 0, 0, 0.0, (0.0,) * 3, (0.0,) * 3, 0.0, 0.0, "now"), State.LANDING)])
def test_an_estimators_status_counts_where_it_is_of_now(health, state):
    flight = hovering()
    flight.component.on_estimator(health._replace(stamp=flight.stamp if health.stamp < 0 else health.stamp))
    flight.step(0.1)
    assert flight.state is state


@pytest.mark.parametrize("end, what_becomes", [((NAN, 0.0, 0.0), "refused"), ((0.0, 0.0, 0.0), "ignored")])
def test_a_map_with_lines_that_are_none_is_ignored(end, what_becomes):
    params = parameters()
    params = replace(params, nmpc=replace(params.nmpc, lines=replace(params.nmpc.lines, collision=1.0)))
    flight = Flight(params=params).take_off()
    flight.component.on_powerlines(PowerlineMap(flight.stamp, (MappedPowerline(1, (0.0, 0.0, 0.0), end, 0.01, np.eye(3), 0.1, 3),), False, ""))
    assert "powerlines: " in flight.said and flight.said.endswith(f": {what_becomes}")
    flight.step(0.1)
    assert flight.state is State.HOVERING


@pytest.mark.parametrize("ahead, said", [(2 * 10**9, True), (-(10**9) * 3600, False)])
def test_a_map_of_the_future_is_ignored_with_a_word_and_an_old_one_is_taken(ahead, said, monkeypatch):
    params = parameters()
    flight, taken = Flight(params=replace(params, nmpc=replace(params.nmpc, lines=replace(params.nmpc.lines, collision=1.0)))), []
    flight.stamp += 2 * 3600 * NANOSECONDS
    flight.step(0.01)
    monkeypatch.setattr(flight.component._assembly, "set_lines", taken.extend)
    line = MappedPowerline(1, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 0.01, np.eye(3), 0.1, 3)
    flight.component.on_powerlines(PowerlineMap(flight.stamp + ahead, (line,), False, ""))
    assert ("in the future" in flight.said) == said and [one.radius for one in taken] == [0.01] * (not said)


def test_of_a_map_that_is_published_once_the_lines_near_the_vehicle_are_used_wherever_it_flies():
    params = parameters(type="nmpc")
    flight = Flight(100.0, replace(params, nmpc=replace(params.nmpc, lines=replace(params.nmpc.lines, collision=1e-6))))
    ys = (3.0, 4.0, 5.0, 90.0, 91.0, 92.0)
    lines = tuple(MappedPowerline(k, (-9.0, y, 2.0), (9.0, y, 2.0), 0.01, np.eye(3), 0.1, 3) for k, y in enumerate(ys))
    flight.component.on_powerlines(PowerlineMap(0, lines, False, ""))  # before any odometry
    for y, near in ((0.0, {3.0, 4.0, 5.0}), (95.0, {90.0, 91.0, 92.0})):
        flight.plant.p = np.array([0.0, y, 0.0])
        flight.step(2.2)
        assert {line[1] for line in flight.component.flight.law._lines} == near


@pytest.mark.parametrize("stamp, near", [(None, set()), (0, {3.0})])
def test_after_a_restart_of_time_a_map_of_the_time_before_is_not_used_and_a_surveyed_one_is(stamp, near):
    params = parameters(type="nmpc")
    flight = Flight(100.0, replace(params, nmpc=replace(params.nmpc, lines=replace(params.nmpc.lines, collision=1e-6))))
    flight.step(0.1)
    line = MappedPowerline(1, (-9.0, 3.0, 2.0), (9.0, 3.0, 2.0), 0.01, np.eye(3), 0.1, 3)
    flight.component.on_powerlines(PowerlineMap(flight.stamp if stamp is None else stamp, (line,), False, ""))
    flight.step(1.2)
    law = flight.component.flight.law
    assert {line[1] for line in law._lines} == {3.0}
    flight.stamp = 5_000_000
    flight.step(1.2)
    assert "time has restarted" in flight.said and {line[1] for line in law._lines} == near


# -- laws and parameters -----------------------------------------------------------------------------------------------


def ask(component, port, request):
    answers = []
    getattr(component, f"on_{port}")(request, answers.append)
    return answers[0]


def test_laws_are_chosen_in_flight_when_they_are_built():
    jobs = []
    flight = Flight()
    flight.component.work = jobs.append
    flight.component.warm_up()
    flight.take_off()
    component = flight.component
    answer = ask(component, "set_controller", SetControllerRequest("pid", False))
    assert (answer.success, answer.error_code) == (False, 1) and "geometric, nmpc" in answer.message
    answer = ask(component, "set_controller", SetControllerRequest("nmpc", False))
    assert (answer.success, answer.error_code) == (False, 2) and "not ready" in answer.message
    job, = jobs
    built = job.function(*job.arguments)
    # Gains that change while it is being built are not lost.
    config = replace(component.config, nmpc=replace(component.config.nmpc, thrust=2.5),
                     gains=replace(component.config.gains, position=(5.0, 5.0, 6.0)))
    component.reconfigure(config)
    job.then(built)
    before = np.array(flight.motors[-1].rotor_speed)
    assert ask(component, "set_controller", SetControllerRequest("nmpc", True)).message == "nmpc+l1 is active"
    flight.step(0.002)
    assert np.abs(np.array(flight.motors[-1].rotor_speed) - before).max() < 0.05 * before.max(), "no jump"
    assert built.settings.thrust == 2.5 and built.fallback.gains.position == (5.0, 5.0, 6.0)
    flight.step(0.5)
    assert flight.status[-1].controller == "nmpc+l1" and np.linalg.norm(flight.plant.v) < 0.05


def test_a_law_whose_settings_are_compiled_in_is_built_again_where_these_have_changed():
    jobs = []
    component = Controller(parameters())
    component.work = jobs.append
    component.warm_up()
    component.reconfigure(replace(component.config, nmpc=replace(component.config.nmpc, horizon=0.5)))
    first = jobs.pop()
    first.then(first.function(*first.arguments))
    assert ask(component, "set_controller", SetControllerRequest("nmpc", False)).error_code == 2
    again = jobs.pop()
    assert again.arguments[2].nmpc.horizon == 0.5


def test_a_law_that_could_not_be_built_says_why():
    jobs = []
    component = Controller(parameters())
    component.work, lines = jobs.append, []
    component.log.receivers.append(lines.append)
    component.warm_up()
    jobs[0].then(PerchError("no compiler"))
    assert "no compiler" in lines[-1].text
    assert "no compiler" in ask(component, "set_controller", SetControllerRequest("nmpc", False)).message


def test_gains_change_in_flight_and_what_is_fixed_is_refused():
    flight = hovering()
    component = flight.component
    old = component.config
    component.reconfigure(replace(old, gains=replace(old.gains, position=(5.0, 5.0, 6.0))))
    assert component.flight.law.gains.position == (5.0, 5.0, 6.0)
    with pytest.raises(ConfigError, match="fixed"):
        component.reconfigure(replace(component.config, vehicle="rpg"))
    with pytest.raises(ConfigError, match="not ready"):
        component.reconfigure(replace(component.config, controller=ControllerChoice(type="nmpc")))
    assert component.config.vehicle == "snapdragon" and component.config.controller.type == "geometric"
    component.reconfigure(replace(component.config, controller=ControllerChoice(adaptive=True)))
    flight.step(0.5)
    assert flight.status[-1].controller == "geometric+l1" and np.linalg.norm(flight.plant.v) < 0.05
    with pytest.raises(ConfigError, match="'pid' is not one of geometric, nmpc"):
        parameters(type="pid")


@pytest.mark.parametrize("period, count", [(0.5, (2, 4)), (0.002, (450, 510))])
def test_the_period_of_the_reference_changes_in_flight(period, count):
    flight = hovering()
    config = flight.component.config
    flight.component.reconfigure(replace(config, controller=replace(config.controller, reference_period=period)))
    flight.references.clear()
    flight.step(1.0)
    assert count[0] <= len(flight.references) <= count[1]


def test_a_parameter_leaves_alone_what_the_service_has_chosen():
    component = Controller(parameters(adaptive=False))
    component._assembly.choose("geometric", True)
    component.reconfigure(replace(component.config, flight=replace(component.config.flight, silence_time=50.0)))
    assert component.flight.law_name == "geometric+l1"
    component._assembly.laws["nmpc"] = component._assembly.laws["geometric"].__class__.build(component._assembly.vehicle, component.config)
    component._assembly.laws["nmpc"].name = "nmpc"
    component._assembly.choose("nmpc", False)
    component.reconfigure(replace(component.config, controller=replace(component.config.controller, adaptive=True)))
    assert component.flight.law_name == "nmpc+l1"


def test_l1_finds_a_heavier_vehicle_at_the_slowest_rate_that_is_flown():
    flight = Flight(30.0, parameters(adaptive=True), Disturbances(mass_factor=1.1)).take_off()
    decayed = np.exp(-10.0 / 30.0)  # of the prediction's error within a period
    assert flight.component.flight.compensator.disturbance[2] == pytest.approx(-0.1 * 9.81 * decayed, rel=0.05)


def test_what_the_ground_does_is_taken_for_no_disturbance():
    """Until it lifts off, the ground carries the vehicle: an upward force that L1 would compensate by less thrust."""
    flight, found = Flight(params=parameters(adaptive=True)), []
    flight.step(0.3)
    flight.order(Command.ARM)
    flight.follow(flight.path((0, 0, 0), (0, 0, 0.6), 2.0))
    for _ in range(150):
        flight.step(0.002)
        x = flight.component.flight.flight_state
        found += [np.abs(flight.component.flight.compensator.disturbance).max()] * (x.mode is State.TRACKING and x.at_ground)
    assert len(found) > 50 and max(found) == 0.0


def test_below_the_place_of_the_take_off_a_disturbance_is_air():
    flight = Flight(params=parameters(adaptive=True), disturbances=Disturbances(mass_factor=1.1))
    flight.plant.p, flight.plant.floor = np.array([0.0, 0.0, 1.0]), 1.0
    flight.step(0.3)
    flight.order(Command.ARM)
    flight.follow(flight.path((0, 0, 1.0), (0, 0, 1.5), 1.0))
    flight.step(1.2)
    flight.plant.floor = 0.0
    flight.follow(flight.path(flight.plant.p, (0, 0, 0.5), 1.5), id=6)
    flight.step(3.0)
    assert flight.state is State.HOVERING and flight.plant.p[2] == pytest.approx(0.5, abs=0.03)
    flight.order(Command.HOVER)
    flight.step(0.5)
    assert flight.state is State.HOVERING, "the ground is not there"


def test_abort_brakes_to_a_hover():
    flight = hovering()
    flight.follow(flight.path((0, 0, 0.6), (2, 0, 0.6), 2.0), id=6)
    flight.step(1.0)
    answer = ask(flight.component, "abort", TriggerRequest())
    assert answer.success and "abort" in answer.message
    flight.step(1.5)
    assert flight.state is State.HOVERING and np.linalg.norm(flight.plant.v) < 0.05 and flight.plant.p[0] < 2.6


@pytest.mark.parametrize("command, success, message", [
    (Command.LAND, True, "already landing: landing: test"), (Command.KILL, False, "abort is refused: killed: test")])
def test_abort_answers_what_is_done(command, success, message):
    flight = hovering()
    flight.order(command)
    assert ask(flight.component, "abort", TriggerRequest()) == TriggerResponse(success, message)


GUIDE = Path(__file__).resolve().parents[2] / "docs/howto/own_controller.md"


def test_the_law_of_the_guide_flies(tmp_path, monkeypatch):
    text, = re.findall(r"```py\n# pd_law.py\n(.*?)```", GUIDE.read_text(), re.S)
    (tmp_path / "pd_law.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    name, place = re.search(r'^"(\w+)": "([\w:.]+)",$', GUIDE.read_text(), re.M).groups()
    monkeypatch.setitem(LAWS, name, place.removeprefix("perch_control."))  # here the file is on the path
    flight = Flight(params=parameters(type=name)).take_off()
    assert flight.status[-1].controller == "pd+l1"
    flight.follow(flight.path((0, 0, 0.6), (1.5, 1.0, 1.0), 2.0), id=6)
    flight.step(1.0)
    reference = np.array(flight.references[-1].p)
    assert np.linalg.norm(flight.plant.p - reference) < 0.08  # it aims 20 ms ahead, at 1.8 m/s
    flight.step(1.5)
    np.testing.assert_allclose(flight.plant.p, [1.5, 1.0, 1.0], atol=0.02)
    assert ask(flight.component, "set_controller", SetControllerRequest("geometric", False)).success
    flight.step(0.3)
    assert ask(flight.component, "set_controller", SetControllerRequest("pd", True)).message == "pd+l1 is active"
    flight.step(0.5)
    assert flight.state is State.HOVERING and np.linalg.norm(flight.plant.v) < 0.05
