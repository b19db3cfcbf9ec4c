"""The standard deviation along the worst axis, and what drift adds."""

from __future__ import annotations

import numpy as np
import pytest

from perch_core import so3
from perch_core.covariance import drift, largest_sigma


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


@pytest.mark.slow
def test_drift_moves_the_vehicle_and_leaves_what_was_seen():
    """Against drawn poses: the place relative to the vehicle before and after the increment."""
    rng = np.random.default_rng(1)
    u, L = np.array([3.0, -1.0, 0.5]), 1e-3 * rng.normal(size=(6, 6))
    w = rng.normal(size=(100_000, 6)) @ L.T
    moved = np.array([so3.exp(-one[3:]) @ (u - one[:3]) for one in w[:20_000]])  # in axes of the vehicle, which was level and at 0
    before = np.diag([0.1, 0.2, 0.3, 0.1, 0.1, 0.4]) ** 2
    added = drift(before + L @ L.T, before, u)
    np.testing.assert_allclose(added[:3, :3], np.cov(moved.T), atol=0.03 * added[:3, :3].max())
    np.testing.assert_allclose(added[3:, 3:], L[3:] @ L[3:].T, atol=1e-12)


def test_odometry_that_became_surer_has_not_drifted():
    assert not drift(np.eye(6), 2.0 * np.eye(6), np.ones(3)).any()
