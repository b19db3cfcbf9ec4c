"""The proof that single rotors keep their range: Taylor models enclose what they stand for, and its verdicts are those of samples."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from perch_core.surface import PerchSurface
from perch_core.vehicle import load_vehicle
from perch_planner import taylor_models
from perch_planner.planner import plan
from perch_planner.problem import Limits, PerchProblem, PerchSettings, StartState
from perch_planner.rotor_proof import prove_rotors
from perch_planner.rotor_thrusts import bases_at, headings, motion, rotor_model, thrusts_along
from random_perches import shipped_settings

VEHICLE = load_vehicle("snapdragon")
ROTORS = rotor_model(VEHICLE)
T = np.linspace(-1.0, 1.0, 201)
small = st.floats(-2.0, 2.0)
place = st.floats(-1.0, 1.0)
FUNCTIONS = {
    "mul": (taylor_models.mul, lambda a, b: a * b), "add": (taylor_models.add, lambda a, b: a + b), "sub": (taylor_models.sub, lambda a, b: a - b),
    "sine": (lambda a, b: taylor_models.sine(a, np.sin(a[0]), np.cos(a[0])), lambda a, b: np.sin(a)),
    "cosine": (lambda a, b: taylor_models.sine(a, np.cos(a[0]), -np.sin(a[0])), lambda a, b: np.cos(a)),
    "times": (lambda a, b: taylor_models.times(-1.7, a), lambda a, b: -1.7 * a),
}


def switched(m, d, c, e, s):
    """A function whose second derivative is c + e before s and c - e after it, and its model."""
    beyond, side = T - s, 1.0 if s >= 0.0 else -1.0  # of s, 0 lies on
    bend = side * np.where(side * beyond <= 0.0, 0.5 * T**2, 0.5 * s**2 + s * beyond - 0.5 * beyond**2)
    return m + d * T + 0.5 * c * T**2 + e * bend, (m, d, c, abs(e))


def check_encloses(model, values):
    """The bounds hold, and so does the second derivative."""
    assert taylor_models.least(model) <= values.min() + 1e-9 and values.max() - 1e-9 <= taylor_models.greatest(model)
    assert model[0] == pytest.approx(values[100], abs=1e-9)
    assert model[1] == pytest.approx((values[101] - values[99]) / (T[101] - T[99]), rel=1e-2, abs=1e-1)
    bend = np.diff(values, 2) / (T[1] - T[0]) ** 2
    assert np.abs(bend - model[2]).max() <= model[3] + 1e-3 * (1.0 + np.abs(bend).max())  # differences are not derivatives


@pytest.mark.parametrize("name", FUNCTIONS)
@given(a=st.tuples(small, small, small, small, place), b=st.tuples(small, small, small, small, place))
@settings(max_examples=100)
def test_arithmetic_encloses_values_and_second_derivatives(name, a, b):
    (x, xm), (y, ym) = switched(*a), switched(*b)
    number, function = FUNCTIONS[name]
    check_encloses(number(xm, ym), function(x, y))


@given(a=st.tuples(st.floats(8.0, 20.0), small, small, small, place))
@example(a=(8.0, 0.0, 1.0, 0.0, 0.0))  # least in the middle
@settings(max_examples=100)
def test_the_inverse_root_encloses_values_and_second_derivatives(a):
    x, model = switched(*a)
    check_encloses(taylor_models.inverse_root(model), x**-0.5)


@pytest.fixture(scope="module", params=[30.0, 60.0, 90.0, 120.0])
def planned(request):
    """Position and yaw coefficients, durations, certificate of the rotors and extrema of 2,000 samples for each segment."""
    surface = PerchSurface.from_inclination((1.7, 0.3, 1.4), np.radians(request.param))
    found = plan(PerchProblem(StartState((0.0, 0.0, 1.2)), surface), PerchSettings(), VEHICLE)
    rows = found.trajectory.coefficients
    position, yaw, durations = np.ascontiguousarray(rows[:, :3]), np.ascontiguousarray(rows[:, 3]), found.trajectory.durations
    moved, turned = bases_at(np.linspace(0.0, 1.0, 2000))
    thrusts = np.empty((len(durations), 4, 2000))
    for i, duration in enumerate(durations):
        thrusts_along(motion(position[i], duration, moved), headings(yaw[i:i + 1], duration, turned), *ROTORS, thrusts[i])
    certificate = next(c for c in found.certificates if c.quantity == "rotor_thrust")
    return (position, yaw, durations), certificate, thrusts.min(), thrusts.max()


def test_the_certificate_of_a_plan_encloses_every_sample_within_two_percent_of_the_range(planned):
    _, certificate, lowest, highest = planned
    share = 0.02 * (certificate.upper_limit - certificate.lower_limit) + 1e-6
    assert certificate.holds and certificate.lower_limit <= certificate.minimum and certificate.maximum <= certificate.upper_limit
    assert lowest - share <= certificate.minimum <= lowest + 1e-9
    assert highest - 1e-9 <= certificate.maximum <= highest + share


@pytest.mark.parametrize("side", [0, 1])
def test_a_limit_just_inside_of_what_is_attained_fails_and_one_just_outside_is_proved(planned, side):
    arguments, _, lowest, highest = planned
    middle = 0.5 * (lowest + highest)
    for beyond, holds in ((-1e-3, False), (1e-3, True), (1e-5, True)):
        low, high = (lowest - beyond, highest + 0.5) if side == 0 else (lowest - 0.5, highest + beyond)
        answer = prove_rotors(*arguments, middle, middle, low, high, *ROTORS)
        assert answer[0] is holds
        if not holds:
            assert answer[1] < low or answer[2] > high, "what breaks the limit is returned"
            assert lowest - 1e-6 <= answer[1] and answer[2] <= highest + 1e-6, "and it is attained"


def test_a_plan_through_free_fall_is_not_proved(planned):
    (position, yaw, durations), *_ = planned
    falling = position.copy()
    falling[0, 2] = position[0, 2, 0] - 0.5 * 9.81 * (np.arange(15.0) * np.arange(-1.0, 14.0) / (14.0 * 13.0)) * durations[0] ** 2
    falling[0, :2] = 0.0
    assert not prove_rotors(falling, yaw, durations, 0.5, 0.5, -10.0, 10.0, *ROTORS)[0]


def test_limits_of_the_shipped_planner_are_those_that_are_proved(planned):
    _, certificate, *_ = planned
    low, high = Limits.of(shipped_settings(), VEHICLE).rotor_thrust
    assert VEHICLE.thrust_min <= low < high <= VEHICLE.thrust_max
    assert (certificate.lower_limit, certificate.upper_limit) == (low, high) and certificate.method == "interval"


def test_the_proof_does_not_depend_on_the_origin():
    rng, grid = np.random.default_rng(3), 2.0**-24
    velocity = np.cumsum(np.cumsum(rng.normal(0.0, 0.001, (3, 14)), axis=1), axis=1)
    position = np.round(np.hstack([np.zeros((3, 1)), np.cumsum(velocity, axis=1) * 0.01]) / grid)[None] * grid
    answers = [prove_rotors(position + far, np.zeros((1, 15)), np.ones(1), 0.6, 0.6, -50.0, 50.0, *ROTORS) for far in (0.0, 2.0**13)]
    assert answers[0] == answers[1] and answers[0][0]
