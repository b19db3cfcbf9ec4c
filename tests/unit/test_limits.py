"""Limits of inputs: each kind of limit, the door before every component, and the page that says so."""

from __future__ import annotations

from math import inf, nan
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from perch_core.component import Component, Input
from perch_core.errors import ConfigError
from perch_core.ros import topics
from perch_core.trajectory import FlatTrajectory, rest_to_rest
from perch_core.values import (
    AttitudeThrust, ImuSample, InertialState, MappedPowerline, MotorCommand, OdometryState, PerchGoal, PowerlineMap, RatesThrust, RotorState,
    TrajectoryOrder, limits)
from perch_eval.limits_page import page

ROOT = Path(__file__).resolve().parents[2]
IMU = ImuSample(0, (0.1, 0.2, 0.3), (0.0, 0.0, 9.81))
ODOMETRY = OdometryState(0, (0.0,) * 3, (0.0, 0.0, 0.0, 1.0), (0.0,) * 3, (0.0,) * 3, np.eye(6), np.eye(6))
MOTORS = MotorCommand(0, True, (900.0,) * 4)
ROTORS = RotorState(0, (0.0,) * 4, (0.0,) * 4)
LINE = MappedPowerline(1, (0.0, 0.0, 3.0), (1.0, 0.0, 3.0), 0.01, np.eye(3), 0.1, 5)
UNEVEN = np.eye(3) + np.triu(np.ones((3, 3)), 1)


@pytest.mark.parametrize("value, said", [
    (IMU, ""), (ODOMETRY, ""), (PowerlineMap(0, (LINE,) * 500, False, ""), ""), (PerchGoal(), ""),
    (IMU._replace(f_B=(0.0, nan, 0.0)), "f_B: nan is not finite"), (IMU._replace(w_B=(101.0, 0.0, 0.0)), "w_B: 101 is outside [-100, 100] rad/s"),
    (IMU._replace(w_B=(0.0, 0.0)), "w_B: shape (2,) is not 3"), (IMU._replace(frame="x" * 300), "frame: 'xxx"),
    (ODOMETRY._replace(q_WB=(0.0, 0.0, 0.0, 1.01)), "q_WB: norm 1.0100 is not 1"), (ODOMETRY._replace(p_WB=(0.0, inf, 0.0)), "p_WB: inf is not finite"),
    (ODOMETRY._replace(pose_covariance=-np.eye(6)), "pose_covariance: a variance of -1 is negative"), (ODOMETRY._replace(twist_covariance=-np.eye(6)), ""),
    (ODOMETRY._replace(twist_covariance=np.full((6, 6), nan)), "twist_covariance: an entry of nan is not finite"),
    (PowerlineMap(0, (LINE,) * 501, False, ""), "lines: 501 entries are more than 500"),
    (PowerlineMap(0, (LINE, LINE._replace(covariance=UNEVEN)), False, ""), "lines[1].covariance: is not symmetric"),
    (PerchGoal(takeoff_height=0.1), "takeoff_height: 0.1 is outside [0.3, 10] m"), (PerchGoal(attempts=10**6), "attempts: 1e+06 is outside"),
    (MOTORS, ""), (MOTORS._replace(rotor_speed=(0.0, 0.0, 0.0, -1.0)), "rotor_speed: -1 is outside [0, 10000] rad/s"),
    (MOTORS._replace(rotor_speed=(900.0,) * 3), "rotor_speed: shape (3,) is not 4"),
    (ROTORS, ""), (ROTORS._replace(speed=(0.0, 0.0, nan, 0.0)), "speed: nan is not finite"), (ROTORS._replace(speed=()), "speed: shape (0,) is not 4"),
    ("a value without limits", "")])
def test_a_value_is_refused_with_field_value_and_range(value, said):
    assert limits.problem(value).startswith(said) and bool(limits.problem(value)) == bool(said)


def test_a_value_that_several_components_take_is_judged_once(monkeypatch):
    judged, state = [], ODOMETRY._replace(stamp=1)
    monkeypatch.setitem(limits._FAST_CHECKS, OdometryState, lambda value: judged.append(value) or True)
    assert not limits.problem(state) and not limits.problem(state) and len(judged) == 1
    assert not limits.problem(state._replace()) and len(judged) == 2
    bad = IMU._replace(f_B=(0.0, nan, 0.0))
    assert limits.problem(bad) and limits.problem(bad), "what is refused is refused again"


@pytest.mark.parametrize("command", [MotorCommand(0, True, (nan,) * 4), RatesThrust(0, True, (0.0, nan, 0.0), 9.81),
                                     AttitudeThrust(0, True, (0.0, 0.0, 0.0, 1.0), (0.0,) * 3, nan)])
def test_motors_stop_whatever_else_a_command_says(command):
    assert limits.problem(command) and not limits.problem(command._replace(armed=False))


@pytest.mark.parametrize("limit", [limits.VELOCITY, limits.Limit(0.0, inf, "s"), limits.Limit(0.3, 10.0, "m", optional=True)])
@pytest.mark.parametrize("x", [0.0, -0.0, 0.3, 5.0, 100.0, 100.1, -100.0, inf, -inf, nan])
def test_floats_and_arrays_have_the_same_limits(limit, x):
    value = (0.5, x, 0.5) if limit.shape else x
    assert limit.problem(value) == limit.problem(np.array(value))


def test_valid_floats_are_judged_without_numpy(monkeypatch):
    state = RotorState(7, (1200.0, 1200.0, 1200.0, 1200.0), (0.7, 0.7, 0.7, 0.7))
    monkeypatch.setattr(limits, "np", None)
    assert not limits.problem(state)


def test_valid_vectors_are_judged_without_numpys_comparisons(monkeypatch):
    limit = limits.LIMITS[InertialState]["p_WB"]
    refused = [limit.problem(np.array(value)) for value in ([1e5, 0.0, 0.0], [0.0, np.nan, 0.0], [0.0, 0.0])]
    assert refused == ["100000 is outside [-10000, 10000] m", "nan is not finite", "shape (2,) is not 3"]
    monkeypatch.setattr(limits, "np", SimpleNamespace(asarray=np.asarray))
    assert not limit.problem(np.array([1.0, -2.0, 1e4]))


def test_a_request_is_refused_with_its_source():
    with pytest.raises(ConfigError, match=r"request: lines\[0\].radius: 3 is outside \[0.0001, 1\] m"):
        limits.check("request", PowerlineMap(0, (LINE._replace(radius=3.0),), False, ""))


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_coefficients_that_no_trajectory_has_are_refused_without_a_sum_that_overflows():
    order = TrajectoryOrder.of(1, FlatTrajectory(np.ones(1), np.full((1, 4, 8), 1e308)))
    received = topics.topic("trajectory").read(topics.serialize_message(topics.topic("trajectory").to_message(order)))
    assert limits.problem(received).startswith("trajectory: coefficients: 1e+308 is outside [-10000, 10000] m or rad")
    assert not limits.problem(TrajectoryOrder.of(1, rest_to_rest((0.0,) * 3, (9e3,) * 3, 0.0, 1.0, 100.0)))
    with pytest.raises(ConfigError, match=r"current: coefficients: 1e\+308 is outside"):
        limits.check("current", order.trajectory, limits.CURRENT)


ODD = (0.0, -1.0, 1.0, 99.0, 101.0, 2001.0, -1.1e4, 1e9, nan, inf, -inf)


@pytest.mark.parametrize("value", [IMU, ODOMETRY, MOTORS])
def test_the_quick_answer_accepts_only_what_the_declarations_accept(value):
    for name, limit in limits.LIMITS[type(value)].items():
        whole = getattr(value, name)
        if isinstance(whole, str):
            continue
        for place in np.ndindex(np.shape(whole)):
            for odd in ODD:
                entries = np.array(whole, float)
                entries[place] = odd
                entries = entries if isinstance(whole, np.ndarray) else tuple(entries.tolist())
                assert bool(limits.problem(value._replace(**{name: entries}))) == bool(limit.problem(entries)), (name, place, odd)


class Taker(Component[None]):
    """Keeps what it gets."""

    imu = Input(ImuSample, "imu/data_raw")
    answered = Input(OdometryState, "odometry", answered=True)

    def __init__(self):
        super().__init__(None)
        self.got, self.said = [], []
        self.log.receivers.append(self.said.append)

    def on_imu(self, value):
        self.got.append(value)

    def on_answered(self, value):
        self.got.append(value)


def test_nonsense_does_not_pass_the_door_unless_it_is_answered():
    taker = Taker()
    bad = IMU._replace(f_B=(nan, 0.0, 0.0)), ODOMETRY._replace(p_WB=(nan, 0.0, 0.0))
    for port in (Taker.imu, Taker.answered):
        handle = port.handler(taker)
        for value in (IMU, *bad):
            if isinstance(value, port.value):
                handle(value)
    assert taker.got == [IMU, bad[1]]
    assert [(line.level, line.text) for line in taker.said] == [("warning", "imu/data_raw: f_B: nan is not finite: refused")]


def test_a_message_is_measured_before_it_is_read():
    with pytest.raises(Exception, match="bytes are more than 1048576"):
        topics.topic("trajectory").read(bytes(1 << 20) + b"\0")


def test_the_page_is_what_the_declarations_say():
    assert (ROOT / "docs" / "limits.md").read_text() == page(), "python3 scripts/limits.py writes it"


@pytest.mark.parametrize("channel", ["rates_thrust_command", "controller/command"])
def test_the_page_names_the_nodes_of_autopilots(channel):
    line = next(line for line in page().splitlines() if line.startswith(f"| `{channel}`"))
    assert "betaflight" in line and "mavlink" in line
