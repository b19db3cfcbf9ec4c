"""Bounds of polynomials: subdivision and Sturm's chain against exact rationals, numpy's roots and dense samples."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import exact_sturm
from perch_core import bernstein
from perch_core.flatness import flat_to_state
from perch_core.vehicle import GRAVITY
from perch_planner import bounds, plan_checks
from perch_planner.body_rate_bound import rate_coarse_bound, rate_maximum, rate_parts
from perch_planner.paper import sturm
from perch_planner.plan_checks import specific_force

seeds = st.integers(0, 2**31 - 1)


def thrust_like(seed: int) -> np.ndarray:
    """A squared norm of degree 24, as [M:eq16] gives."""
    force = np.random.default_rng(seed).normal(0.0, 5.0, (3, 13))
    force[2] += 9.81
    return bernstein.product(force, force).sum(axis=0)


@given(seeds)
@settings(max_examples=60)
def test_maximum_is_enclosed_and_attained(seed):
    """[tests M:alg1]"""
    poly = thrust_like(seed)
    attained, proved, place = bounds.maximum(poly, 1e-9 * np.abs(poly).max(), -np.inf)
    dense = bernstein.evaluate(poly, np.linspace(0.0, 1.0, 2001))
    assert proved >= dense.max()
    assert attained == pytest.approx(float(bernstein.evaluate(poly, place)), rel=1e-9)
    assert proved - attained <= 2e-9 * np.abs(poly).max()


@given(seeds, st.floats(0.5, 1.5))
@settings(max_examples=60)
def test_a_floor_leaves_the_bound_proved(seed, share):
    poly = thrust_like(seed)
    dense = bernstein.evaluate(poly, np.linspace(0.0, 1.0, 2001)).max()
    tolerance = 1e-6 * np.abs(poly).max()
    attained, proved, _ = bounds.maximum(poly, tolerance, share * dense)
    assert proved >= dense
    assert proved <= max(attained, share * dense) + 2.0 * tolerance
    assert attained <= dense * (1.0 + 1e-4)


def test_a_floor_saves_work(monkeypatch):
    """The higher it is, the fewer halvings the plain function takes; none where it is above all coefficients."""
    halvings, split, counts = [], bounds.split, []
    monkeypatch.setattr(bounds, "split", lambda *halves: halvings.append(halves) or split(*halves))
    for floor in (-np.inf, 0.05, 0.3):
        halvings.clear()
        _, proved, _ = getattr(bounds.maximum, "py_func", bounds.maximum)(np.array([-0.09, 0.21, -0.49]), 1e-9, floor)  # -(s - 0.3)^2
        assert 0.0 <= proved <= max(floor, 0.0) + 2e-9
        counts.append(len(halvings))
    assert counts[0] > counts[1] > counts[2] == 0


@given(seeds)
@settings(max_examples=30)
def test_thrust_extrema_of_a_plan_are_close_and_those_of_its_segments_are_proved(seed):
    """[tests M:eq9, M:eq16]"""
    rng = np.random.default_rng(seed)
    segments = np.cumsum(np.cumsum(rng.normal(0.0, 0.01, (4, 3, 15)), axis=2), axis=2)
    durations = rng.uniform(0.4, 1.0, 4)
    extrema, least, most, *_ = plan_checks.thrust_extrema(segments, durations, 9.0, 16.0)
    places = np.linspace(0.0, 1.0, 1001)
    norms = []
    for segment, duration in zip(segments, durations):
        force = bernstein.evaluate(bernstein.derivative(segment, 2), places) / duration**2
        force[2] += GRAVITY
        norms.append(np.linalg.norm(force, axis=0))
    for row, norm in zip(extrema, norms):
        assert row[1] <= norm.min() * (1.0 + 1e-9) and norm.max() <= row[4] * (1.0 + 1e-9)
        if norm.max() > 16.0:  # beyond the limit each segment's peak is known closely
            assert row[3] == pytest.approx(norm.max(), rel=2e-3)
        if norm.min() < 9.0:
            assert row[1]**2 == pytest.approx(norm.min()**2, abs=3e-3 * norm.max()**2)
    assert most == extrema[:, 4].max() and least == extrema[:, 1].min()
    assert most == pytest.approx(max(n.max() for n in norms), rel=2e-3)


@given(seeds, st.sampled_from([1e-2, 1e-4, 1e-6, 1e-9]), st.sampled_from([-1.0, 1.0]))
@settings(max_examples=60)
def test_verdicts_agree_with_exact_sturm_down_to_tiny_margins(seed, margin, side):
    poly = thrust_like(seed)
    attained, _, _ = bounds.maximum(poly, 1e-13 * np.abs(poly).max(), -np.inf)
    bound = attained * (1.0 + side * margin)
    verdict, _ = bounds.stays_below(poly, bound)
    assert verdict != bounds.UNDECIDED
    assert (verdict == bounds.BELOW) == exact_sturm.stays_below(poly.tolist(), bound)


def test_a_polynomial_on_its_bound_is_not_called_below():
    touching = np.zeros(3)
    assert bounds.stays_below(touching, 0.0)[0] != bounds.BELOW
    parabola = np.array([-0.09, 0.21, -0.49])  # -(s - 0.3)^2
    assert bounds.stays_below(parabola, 0.0)[0] != bounds.BELOW


def test_the_papers_example_of_sturms_chain():
    """[tests M:eq18, M:eq19]"""
    powers = np.array([-1.0, -1.0, 0.0, 1.0, 1.0])
    chain, degrees = sturm.sturm_chain(powers)
    expected = [[-1, -1, 0, 1, 1], [-1, 0, 3, 4], [0.9375, 0.75, 0.1875], [-64, -32], [-0.1875]]
    for row, degree, wanted in zip(chain, degrees, expected):
        scaled = np.array(wanted) / np.abs(wanted).max()
        assert row[:degree + 1] == pytest.approx(scaled)
    assert sturm.count_roots(powers, 0.0, 2.0) == 1
    assert exact_sturm.count_roots([Fraction(c) for c in (-1, -1, 0, 1, 1)], Fraction(0), Fraction(2)) == 1


@given(st.lists(st.integers(1, 19), min_size=1, max_size=5, unique=True))
def test_both_chains_count_the_roots_that_were_put_in(roots):
    """[tests M:eq18]"""
    powers = [Fraction(1)]
    for root in roots:
        powers = [a - Fraction(root, 20) * b for a, b in zip([Fraction(0), *powers], [*powers, Fraction(0)])]
    assert exact_sturm.count_roots(powers) == len(roots)
    assert sturm.count_roots(np.array([float(c) for c in powers]), 0.0, 1.0) == len(roots)


@given(seeds)
@settings(max_examples=30)
def test_algorithm_1_agrees_with_subdivision_at_wide_margins(seed):
    poly = thrust_like(seed)
    attained, _, _ = bounds.maximum(poly, 1e-9 * np.abs(poly).max(), -np.inf)
    powers = bernstein.to_powers(poly / attained)
    assert sturm.global_bound_check(powers, 1.2, 0.0, 1.0)
    assert not sturm.global_bound_check(powers, 0.8, 0.0, 1.0)


@given(st.lists(st.floats(-2.0, 2.0), min_size=2, max_size=15), st.lists(st.floats(-2.0, 2.0), min_size=2, max_size=15),
       st.floats(0.0, 1.0))
def test_kernels_agree_with_the_library(a, b, s):
    a, b = np.array(a), np.array(b)
    assert bounds.product(a, b) == pytest.approx(bernstein.product(a, b), abs=1e-12)
    assert bounds.derivative(a, 1) == pytest.approx(bernstein.derivative(a), abs=1e-12)
    assert bounds.value(a, s) == pytest.approx(float(bernstein.evaluate(a, s)), abs=1e-12)
    assert bounds.bernstein_row(len(a) - 1, s) == pytest.approx(bernstein.basis(len(a) - 1, s), abs=1e-12)


def motion(seed: int) -> tuple[np.ndarray, np.ndarray, float]:
    """A segment of degree 14 with turning yaw, away from free fall."""
    rng = np.random.default_rng(seed)
    coefficients = np.cumsum(np.cumsum(rng.normal(0.0, 0.0015, (3, 15)), axis=1), axis=1)
    yaw = rng.uniform(-3.0, 3.0) + np.cumsum(rng.normal(0.0, 0.1, 15))
    return coefficients, yaw, rng.uniform(0.5, 1.0)


def rate_by_flatness(coefficients, yaw, duration, s) -> float:
    """|omega| by the other implementation, in perch_core."""
    a, j, snap = (bernstein.evaluate(bernstein.derivative(coefficients, k), s) / duration**k for k in (2, 3, 4))
    angles = [float(bernstein.evaluate(bernstein.derivative(yaw, k), s)) / duration**k for k in range(3)]
    return float(np.linalg.norm(flat_to_state(np.zeros(3), np.zeros(3), a, j, snap, *angles, 1.0).w_WB_B))


@given(seeds)
@settings(max_examples=40)
def test_body_rate_is_that_of_flatness_and_its_bound_is_one(seed):
    coefficients, yaw, duration = motion(seed)
    force = specific_force(coefficients, duration)
    jerk = bernstein.derivative(coefficients, 3) / duration**3
    parts = rate_parts(force, bounds.squared(force), jerk, yaw, duration)
    worst = max(rate_by_flatness(coefficients, yaw, duration, s) for s in np.linspace(0.0, 1.0, 41))
    attained, proved, place = rate_maximum(parts, 0.0, np.inf)
    assert attained == pytest.approx(rate_by_flatness(coefficients, yaw, duration, place), rel=1e-6)
    assert worst <= proved * (1.0 + 1e-9) and proved <= 1.04 * attained
    assert rate_maximum(parts, 0.0, 0.95 * worst)[0] >= 0.95 * worst  # broken limits are found out
    _, proved, _ = rate_maximum(parts, 0.0, 1.001 * attained)  # and those between the enclosure's ends are decided
    if proved == np.inf:
        attained, _, place = rate_maximum(parts, 0.0, 1.001 * attained)
        assert rate_by_flatness(coefficients, yaw, duration, place) >= attained * (1.0 - 1e-6)
    else:
        assert worst <= proved <= 1.001 * attained


@given(seeds)
@settings(max_examples=40)
def test_the_coarse_bound_of_the_body_rate_is_one(seed):
    coefficients, yaw, duration = motion(seed)
    jerk = bernstein.derivative(coefficients, 3) / duration**3
    force = specific_force(coefficients, duration)
    coarse = rate_coarse_bound(force, bounds.squared(force), jerk, yaw, duration)
    assert coarse >= max(rate_by_flatness(coefficients, yaw, duration, s) for s in np.linspace(0.0, 1.0, 41))


def test_squared_length_has_the_coefficients_of_the_product_with_itself():
    vector = np.random.default_rng(3).normal(size=(3, 13))
    assert bounds.squared(vector) == pytest.approx(bernstein.product(vector, vector).sum(axis=0), abs=1e-13)


@given(seeds)
@settings(max_examples=40)
def test_halves_are_the_polynomial_on_their_halves(seed):
    rng = np.random.default_rng(seed)
    whole = rng.normal(size=rng.integers(1, 50))
    right, left = whole.copy(), np.empty(len(whole))
    bounds.split(right, left)
    for s in np.linspace(0.0, 1.0, 7):
        assert bernstein.evaluate(left, s) == pytest.approx(bernstein.evaluate(whole, 0.5 * s), abs=1e-12)
        assert bernstein.evaluate(right, s) == pytest.approx(bernstein.evaluate(whole, 0.5 + 0.5 * s), abs=1e-12)


@pytest.mark.parametrize("limit", [1e-2, 1e-3, 1e-6])
def test_a_small_limit_of_the_body_rate_is_proved_not_sampled(limit):
    """A yaw rate of 1 rad/s that vanishes at the 13 places where rates are sampled."""
    nodes, samples = bernstein.basis(13, np.linspace(0.0, 1.0, 14)), np.linspace(0.0, 1.0, 13)
    rate = np.linalg.solve(nodes, [np.prod(s - samples) for s in np.linspace(0.0, 1.0, 14)])
    rate /= np.abs(bernstein.evaluate(rate, np.linspace(0.0, 1.0, 1001))).max()
    still, T, up = np.zeros((1, 3, 15)), np.ones(1), np.array([0.0, 0.0, 1.0])
    thrust, _, _, forces, squares = plan_checks.thrust_extrema(still, T, 1.0, 20.0)

    def holds(yaw):
        return plan_checks.check(still, yaw, T, thrust, forces, squares, -5.0 * up, 0.0 * up, up, 1.0, 20.0, 5.0, -1.0, 1.0, 0.1, 0.0, 0.0, limit)[2]

    assert not holds(np.concatenate([[0.0], np.cumsum(rate) / 14.0])[None])
    assert holds(np.zeros((1, 15)))


def test_algorithm_1_sees_what_begins_on_its_bound_with_a_multiple_root():
    assert not sturm.global_bound_check(np.array([0.0, 0.0, 0.5, -1.0]), 0.0, 0.0, 1.0)  # t^2 (0.5 - t)
