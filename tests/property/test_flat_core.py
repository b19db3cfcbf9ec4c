"""Bernstein polynomials, flatness and trajectories against scipy, numpy.polynomial and finite differences."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import BPoly
from scipy.spatial.transform import Rotation

from perch_core import bernstein
from perch_core.errors import FreeFallError
from perch_core.flatness import HeadingError, attitude, flat_to_state
from perch_core.trajectory import FlatTrajectory, SampledTrajectory, rest_to_rest

numbers = st.floats(-3.0, 3.0, allow_nan=False)
seeds = st.integers(0, 2**31 - 1)
quick = settings(max_examples=40, deadline=None)


def polynomials(low: int = 0, high: int = 14):
    return st.lists(numbers, min_size=low + 1, max_size=high + 1).map(np.array)


@quick
@given(polynomials(), st.floats(0.0, 1.0), st.integers(0, 4))
def test_values_and_derivatives_agree_with_scipy(c, s, order):
    peer = BPoly(c[:, None], [0.0, 1.0])
    expected = peer.derivative(order)(s) if order else peer(s)
    assert bernstein.evaluate(bernstein.derivative(c, order), s) == pytest.approx(float(expected), abs=1e-8 * 14**order)


@quick
@given(polynomials(), polynomials(), st.floats(0.0, 1.0))
def test_product_is_the_product_of_the_values(a, b, s):
    expected = bernstein.evaluate(a, s) * bernstein.evaluate(b, s)
    assert bernstein.evaluate(bernstein.product(a, b), s) == pytest.approx(expected, abs=1e-11)


@quick
@given(polynomials(), st.integers(0, 10), st.floats(0.0, 1.0))
def test_elevation_and_powers_keep_the_polynomial(c, more, s):
    value = bernstein.evaluate(c, s)
    assert bernstein.evaluate(bernstein.elevate(c, len(c) - 1 + more), s) == pytest.approx(value, abs=1e-11)
    powers = bernstein.to_powers(c)
    assert np.polynomial.polynomial.polyval(s, powers) == pytest.approx(value, abs=1e-7)


def random_trajectory(seed: int, segments: int = 3, degree: int = 9) -> FlatTrajectory:
    """A trajectory without free fall: accelerations stay small against gravity."""
    rng = np.random.default_rng(seed)
    coefficients = np.cumsum(rng.normal(0.0, 0.02, (segments, 4, degree + 1)), axis=-1)
    coefficients[:, 3] = rng.uniform(-3, 3) + 5.0 * coefficients[:, 3]
    return FlatTrajectory(rng.uniform(0.7, 1.5, segments), coefficients, start_time=12.5)


@quick
@given(seeds, st.floats(0.05, 0.95))
def test_samples_carry_the_derivatives_of_the_flat_outputs(seed, fraction):
    """[tests M:eq3, M:eq17]"""
    trajectory = random_trajectory(seed)
    t = fraction * trajectory.duration
    x = BPoly(trajectory.coefficients.transpose(2, 0, 1), [0.0, *np.cumsum(trajectory.durations)])
    sample = trajectory.sample(t)
    for order, value in enumerate((sample.p, sample.v, sample.a, sample.j, sample.s)):
        expected = x.derivative(order)(t) if order else x(t)
        assert value == pytest.approx(expected[:3], abs=1e-7)
    assert (sample.yaw, sample.yaw_rate, sample.yaw_acc) == pytest.approx(
        (x(t)[3], x.derivative(1)(t)[3], x.derivative(2)(t)[3]), abs=1e-8)


@quick
@given(seeds)
def test_many_samples_are_the_single_samples_and_times_are_clamped(seed):
    trajectory = random_trajectory(seed)
    times = np.linspace(-0.5, trajectory.duration + 0.5, 17)
    many = trajectory.sample_many(times)
    for k, t in enumerate(times):
        one = trajectory.sample(t)
        assert many.p[k] == pytest.approx(one.p) and many.s[k] == pytest.approx(one.s)
        assert many.yaw_acc[k] == pytest.approx(one.yaw_acc)
    assert many.p[0] == pytest.approx(trajectory.coefficients[0, :3, 0])
    assert many.p[-1] == pytest.approx(trajectory.coefficients[-1, :3, -1])


def state_at(trajectory, t, mass=0.25):
    f = trajectory.sample(t)
    return flat_to_state(f.p, f.v, f.a, f.j, f.s, f.yaw, f.yaw_rate, f.yaw_acc, mass)


@quick
@given(seeds, st.floats(0.1, 0.9))
def test_rates_and_accelerations_are_derivatives_of_the_attitude(seed, fraction):
    """[tests M:eq13]"""
    trajectory = random_trajectory(seed, segments=1)
    t, h = fraction * trajectory.duration, 1e-4
    before, here, after = (state_at(trajectory, t + k * h) for k in (-1, 0, 1))
    turn = Rotation.from_matrix(before.R_WB.T @ after.R_WB).as_rotvec() / (2 * h)
    assert here.w_WB_B == pytest.approx(turn, abs=2e-5 * (1 + np.abs(here.dw_WB_B).max()))
    acceleration = (after.w_WB_B - before.w_WB_B) / (2 * h)
    assert here.dw_WB_B == pytest.approx(acceleration, rel=1e-4, abs=1e-4 * (1 + np.abs(here.dw_WB_B).max()))


@quick
@given(seeds, st.floats(0.0, 1.0))
def test_newton_holds_and_the_attitude_is_a_rotation_with_b2_towards_the_reference(seed, fraction):
    """The inverse of [M:eq9]. [tests M:eq10, M:eq12]"""
    trajectory = random_trajectory(seed)
    t = fraction * trajectory.duration
    sample, state = trajectory.sample(t), state_at(trajectory, t)
    force_W = state.R_WB @ (0.0, 0.0, state.thrust) - 0.25 * np.array([0.0, 0.0, 9.81])
    assert force_W == pytest.approx(0.25 * sample.a, abs=1e-12)
    assert state.R_WB.T @ state.R_WB == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.det(state.R_WB) == pytest.approx(1.0)
    b2_des = np.array([-np.sin(sample.yaw), np.cos(sample.yaw), 0.0])
    assert state.R_WB[:, 0] @ b2_des == pytest.approx(0.0, abs=1e-12)
    assert state.R_WB[:, 1] @ b2_des > 0.0
    assert attitude(state.R_WB[:, 2], sample.yaw) == pytest.approx(state.R_WB, abs=1e-12)


def test_hover_is_level_and_free_fall_is_refused():
    zero = np.zeros(3)
    hover = flat_to_state(zero, zero, zero, zero, zero, 0.7, 0.0, 0.0, 0.25)
    assert hover.R_WB == pytest.approx(Rotation.from_euler("z", 0.7).as_matrix())
    assert hover.thrust == pytest.approx(0.25 * 9.81)
    fall = np.array([0.0, 0.0, -9.81])
    with pytest.raises(FreeFallError):
        flat_to_state(zero, zero, fall, zero, zero, 0.0, 0.0, 0.0, 0.25)
    with pytest.raises(HeadingError):
        flat_to_state(zero, zero, np.array([0.0, 5.0, -9.81]), zero, zero, 0.0, 0.0, 0.0, 0.25)
    with pytest.raises(HeadingError):
        attitude([0.0, 1.0, 0.0], 0.0)


@quick
@given(seeds, st.floats(-3.0, 3.0), st.floats(-3.0, 3.0), st.floats(0.5, 4.0))
def test_rest_to_rest_joins_two_hovers_by_the_shorter_turn(seed, yaw0, yaw1, duration):
    rng = np.random.default_rng(seed)
    p0, p1 = rng.uniform(-2, 2, (2, 3))
    move = rest_to_rest(p0, p1, yaw0, yaw1, duration)
    first, last = move.sample(0.0), move.sample(duration)
    assert first.p == pytest.approx(p0) and last.p == pytest.approx(p1)
    for sample in (first, last):
        for value in (sample.v, sample.a, sample.j, sample.s, [sample.yaw_rate, sample.yaw_acc]):
            assert np.abs(value).max() == pytest.approx(0.0, abs=1e-9)
    assert np.exp(1j * last.yaw) == pytest.approx(np.exp(1j * yaw1))
    assert abs(last.yaw - first.yaw) <= np.pi + 1e-9
    assert move.sample(duration / 2).p == pytest.approx((p0 + p1) / 2)


@pytest.mark.parametrize("durations, shape", [([1.0, -1.0], (2, 4, 8)), ([1.0], (2, 4, 8)), ([1.0], (1, 3, 8)), ([np.nan], (1, 4, 8))])
def test_malformed_trajectories_are_refused(durations, shape):
    with pytest.raises(ValueError):
        FlatTrajectory(np.array(durations), np.zeros(shape))


def test_sampled_trajectory_passes_its_samples_and_turns_evenly():
    times = np.array([0.0, 0.5, 1.5])
    q = Rotation.from_rotvec(np.outer([0.0, 0.4, 1.4], [0, 0, 1])).as_quat()
    ramp = np.outer(times, [1.0, 2.0, 3.0])
    flight = SampledTrajectory(times, ramp, -q, ramp, ramp, ramp, ramp, np.outer(times, np.ones(4)))
    middle = flight.sample(1.0)
    assert middle.p == pytest.approx([1.0, 2.0, 3.0])
    assert abs(middle.q @ Rotation.from_euler("z", 0.9).as_quat()) == pytest.approx(1.0)
    assert flight.sample(-1.0).p == pytest.approx(ramp[0]) and flight.sample(9.0).p == pytest.approx(ramp[-1])
    with pytest.raises(ValueError):
        SampledTrajectory(times[::-1], ramp, q, ramp, ramp, ramp, ramp, np.zeros((3, 4)))


def test_one_sample_and_many_are_the_same_polynomial():
    """The compiled evaluation at one time against the one in numpy at many."""
    rng = np.random.default_rng(4)
    trajectory = FlatTrajectory(np.array([0.7, 1.1, 0.4]), rng.normal(size=(3, 4, 10)))
    times = np.linspace(0.0, trajectory.duration, 101)
    many = trajectory.sample_many(times)
    for k, t in enumerate(times):
        one = trajectory.sample(float(t))
        for name in ("p", "v", "a", "j", "s", "yaw", "yaw_rate", "yaw_acc"):
            expected = getattr(many, name)
            np.testing.assert_allclose(getattr(one, name), expected[k], rtol=1e-9, atol=1e-10 * np.abs(expected).max())
