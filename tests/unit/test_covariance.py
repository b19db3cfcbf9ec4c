"""The standard deviation along the worst axis."""

from __future__ import annotations

import numpy as np
import pytest

from perch_core.covariance import largest_sigma


def test_it_is_the_spread_along_the_worst_direction():
    rng = np.random.default_rng(0)
    L = rng.normal(size=(3, 3))
    samples = rng.normal(size=(200_000, 3)) @ L.T
    directions = rng.normal(size=(4000, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    spread = np.sqrt(np.einsum("ki,ij,kj->k", directions, np.cov(samples.T), directions)).max()
    assert largest_sigma(L @ L.T) == pytest.approx(spread, rel=0.01)


def test_rounding_below_zero_is_zero():
    assert largest_sigma(np.diag([-1e-18, -1e-17])) == 0.0
