"""Catenaries against the hanging chain's differential equation, integrated, and sampled distances."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad, solve_ivp

from perch_core.catenary import Catenary, fit_segments
from perch_core.errors import PerchError

POINT = st.tuples(*[st.floats(-20, 20)] * 3).map(np.array)


def cables(level: bool = False) -> st.SearchStrategy[Catenary]:
    def build(start, azimuth, span, rise, share):
        end = start + [span * math.cos(azimuth), span * math.sin(azimuth), 0.0 if level else rise * span]
        return Catenary.from_sag(start, end, share * span)

    return st.builds(build, POINT, st.floats(-3, 3), st.floats(2, 200), st.floats(-0.6, 0.6), st.floats(0.002, 0.3))


@given(cables())
def test_it_ends_at_its_supports_and_has_the_sag_asked_for(cable):
    scale = cable.length
    np.testing.assert_allclose(cable.point(0.0), cable.start, atol=1e-9 * scale)
    np.testing.assert_allclose(cable.point(cable.length), cable.end, atol=1e-9 * scale)
    chord_middle = (cable.start + cable.end) / 2
    samples = cable.point(np.linspace(0, cable.length, 20_001))
    along = (cable.end - cable.start)[:2]
    height = np.interp(0.0, (samples[:, :2] - chord_middle[:2]) @ along, samples[:, 2])
    assert chord_middle[2] - height == pytest.approx(cable.sag, rel=1e-3)


@given(st.floats(5, 150), st.floats(-0.5, 0.5), st.floats(0.3, 6.0))
def test_it_obeys_the_balance_of_forces(span, rise, stiffness):
    """z'' = (w/H) sqrt(1 + z'^2), integrated from one support with the cable's own slope there."""
    tension, weight = stiffness * span * 3.0, 3.0
    cable = Catenary([0, 0, 10], [span, 0, 10 + rise * span], tension / weight)
    t = cable.point(1e-4) - cable.point(-1e-4)
    flown = solve_ivp(lambda x, y: [y[1], weight / tension * math.sqrt(1 + y[1] ** 2)], [0, span],
                      [10.0, t[2] / t[0]], rtol=1e-10, atol=1e-10, dense_output=True)
    points = cable.sample(50)
    np.testing.assert_allclose(points[:, 2], flown.sol(points[:, 0])[0], atol=1e-6 * span)


@given(cables())
def test_length_is_the_integral_along_the_curve_and_arc_length_is_its_parameter(cable):
    points = cable.sample(4001)
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    assert steps.sum() == pytest.approx(cable.length, rel=1e-5)
    np.testing.assert_allclose(steps, cable.length / 4000, rtol=2e-3)


def test_no_sag_is_a_straight_line_even_a_vertical_one():
    cable = Catenary.from_sag([0, 0, 1], [0, 0, 5], 0.0)
    assert cable.straight and cable.length == 4.0 and cable.sag == 0.0
    np.testing.assert_allclose(cable.sample(3), [[0, 0, 1], [0, 0, 3], [0, 0, 5]])
    assert fit_segments(cable, 2).max_error == 0.0


def distances(cable: Catenary, vertices: np.ndarray) -> np.ndarray:
    points = cable.sample(3001)
    a, b = vertices[:-1], vertices[1:]
    share = np.einsum("nmk,mk->nm", points[:, None] - a, b - a) / np.sum((b - a) ** 2, axis=1)
    nearest = a + np.clip(share, 0, 1)[..., None] * (b - a)
    return np.linalg.norm(points[:, None] - nearest, axis=-1).min(axis=1)


@pytest.mark.slow
@given(cables(), st.integers(1, 25))
def test_stated_errors_of_a_fit_are_its_errors(cable, count):
    fit = fit_segments(cable, count)
    sampled = distances(cable, fit.vertices)
    assert sampled.max() <= fit.max_error * (1 + 1e-6) + 1e-9
    assert sampled.max() >= 0.98 * fit.max_error - 1e-9
    if fit.max_error < 0.02 * cable.length / count:  # else distance along the cable and along the chord differ
        assert sampled.mean() == pytest.approx(fit.mean_error, rel=0.02, abs=1e-9)
    assert len(fit.vertices) == count + 1


@pytest.mark.parametrize("rise", [0.0, 8.0])
def test_powerline_of_185_m_needs_15_segments_for_15_mm(rise):
    """[P:sec. IV-A]: a real powerline of 185 m, 15 segments of 12 m, mean error 1.5 cm."""
    span = 184.0
    cable = Catenary.from_sag([0, 0, 20], [span, 0, 20 + rise], 4.5)
    assert cable.length == pytest.approx(185.0, abs=1.0)
    fit = fit_segments(cable, 15)
    assert fit.mean_error <= 0.015
    assert fit.max_error <= 0.025


@pytest.mark.parametrize("end, sag", [([0.1, 0.0, 12.0], 0.05), ([0.9, 0.0, 60.0], 0.05), ([0.001, 0.0, 50.0], 0.01)])
def test_a_steep_cable_has_the_sag_asked_for(end, sag):
    assert Catenary.from_sag([0, 0, 0], end, sag).sag == pytest.approx(sag, rel=1e-6)


def test_sag_by_an_independent_quadrature():
    """Drop at mid-span = integral of the slope's difference from the chord's; slope' = sqrt(1 + slope^2)/a."""
    cable = Catenary.from_sag([0, 0, 0], [50, 0, 0], 3.0)
    drop, _ = quad(lambda x: -math.sinh((x - 25.0) / cable.parameter), 0, 25.0)
    assert drop == pytest.approx(3.0, rel=1e-9)


@pytest.mark.parametrize("build, message", [
    (lambda: Catenary([0, 0, 0], [0, 0, 0], 5.0), "both ends"),
    (lambda: Catenary([0, 0, 0], [1, 0, 0], -1.0), "parameter"),
    (lambda: Catenary([0, 0, math.nan], [1, 0, 0], 1.0), "finite"),
    (lambda: Catenary.from_sag([0, 0, 0], [0, 0, 5], 0.5), "above the other"),
    (lambda: Catenary.from_sag([0, 0, 0], [1, 0, 0], -0.5), "sag"),
    (lambda: Catenary.from_sag([0, 0, 0], [1, 0, 0], 1e30), "outside"),
    (lambda: fit_segments(Catenary([0, 0, 0], [1, 0, 0], 1.0), 0), "segments")])
def test_impossible_cables_are_refused(build, message):
    with pytest.raises(PerchError, match=message):
        build()
