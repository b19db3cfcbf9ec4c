"""Random walk of tracks: the covariance of a walk, against walks that are simulated."""

import dataclasses

import numpy as np
import pytest
from perch_core import so3
from perch_core.sensors import CalibrationSigmas
from perch_perception.vio.bearing import Bearings, residuals
from perch_perception.vio.config import FilterConfig, VioConfig
from perch_perception.vio.sliding import TrackWalk

FOCAL = 275.0
CONFIG = dataclasses.replace(VioConfig(), calibration=CalibrationSigmas(track=0.3), filter=FilterConfig(slide_turn=2.0, slide_zoom=3.0))


def view(m=9):
    """Bearings and distances of a point that a climbing, turning camera sees."""
    angles = np.cumsum(np.linspace(0.0, 0.08, m))
    return np.stack([np.sin(angles), np.zeros(m), np.cos(angles)], axis=1), np.linspace(0.4, 1.2, m)


def test_whitened_observations_of_walking_points_are_white():
    rng, (b, d) = np.random.default_rng(1), view()
    q = (CONFIG.filter.slide_turn / FOCAL) ** 2 * np.arccos(np.clip((b[1:] * b[:-1]).sum(axis=1), -1, 1))
    q += (CONFIG.filter.slide_zoom / FOCAL) ** 2 * np.log(d[1:] / d[:-1])
    steps = rng.normal(size=(20000, len(q))) * np.sqrt(q)
    # the point is where it is seen last: earlier observations are off by what it has walked in the scene since, as seen from where they were
    walk = -np.concatenate([np.cumsum((steps * d[1:])[:, ::-1], axis=1)[:, ::-1], np.zeros((20000, 1))], axis=1) / d
    noise = np.linspace(1.0, 3.0, len(b))
    seen = walk + rng.normal(size=walk.shape) * noise * CONFIG.calibration.track / FOCAL
    sliding = TrackWalk(CONFIG, FOCAL)
    white = sliding.whitened(sliding.steps(b[:-1], b[1:], d[:-1], d[1:]), d, seen.T, noise) / (CONFIG.calibration.track / FOCAL)
    assert np.cov(white) == pytest.approx(np.eye(len(b)), abs=0.06)


def test_a_view_that_stands_still_makes_nothing_walk():
    b, d = view()
    sliding = TrackWalk(CONFIG, FOCAL)
    assert sliding.steps(b, b, d, d) == pytest.approx(np.zeros(len(b)), abs=1e-12)
    rows = np.random.default_rng(2).normal(size=(4, 3))
    assert sliding.whitened(np.zeros(3), d[:4], rows) == pytest.approx(rows)


def test_points_walk_across_the_line_of_sight_only():
    b, d = view()
    R_WC = so3.exp(np.array([0.3, -2.0, 0.4]))
    P = TrackWalk(CONFIG, FOCAL).of_points(b[:-1], b[1:], d[:-1], d[1:], R_WC)
    u = b[1:] @ R_WC.T
    assert np.einsum("ni,nij,nj->n", u, P, u) == pytest.approx(np.zeros(len(u)), abs=1e-15)
    along = R_WC @ np.array([0.0, 1.0, 0.0])
    angle = np.sqrt(np.einsum("i,nij,j->n", along, P, along)) / d[1:]
    assert angle**2 == pytest.approx(TrackWalk(CONFIG, FOCAL).steps(b[:-1], b[1:], d[:-1], d[1:]))


@pytest.mark.parametrize("x", [(-0.2, 0.2), (0.9, 1.4)])
def test_residuals_of_a_walking_point_are_white_wherever_it_crosses_the_view(x):
    """A camera passes a point at 1 m: near the optical axis, and where it is seen 40 to 55 deg from it."""
    n, m, rng, X = 4000, 11, np.random.default_rng(4), np.array([0.0, 0.5, 1.0])
    centres = np.stack([-np.linspace(*x, m), np.zeros(m), np.zeros(m)], axis=1)
    d = np.linalg.norm(X - centres, axis=1)
    u, sliding, sigma = (X - centres) / d[:, None], TrackWalk(CONFIG, FOCAL), CONFIG.calibration.track / FOCAL
    q = sliding.steps(u[:-1], u[1:], d[:-1], d[1:])
    steps = rng.normal(size=(n, m - 1, 3)) * (np.sqrt(q) * d[1:])[:, None]
    walk = np.concatenate([np.cumsum(steps[:, ::-1], axis=1)[:, ::-1], np.zeros((n, 1, 3))], axis=1)
    b = X + walk - centres + sigma * d[:, None] * rng.normal(size=(n, m, 3))
    seen = Bearings((b / np.linalg.norm(b, axis=2, keepdims=True)).reshape(-1, 3), np.ones((n * m, 2)))
    r = residuals(np.broadcast_to(np.eye(3), (n * m, 3, 3)), np.tile(centres, (n, 1)), np.broadcast_to(X, (n * m, 3)), np.eye(3),
                  np.zeros(3), seen).r
    white = sliding.whitened(q, d, r.reshape(n, m, 2).transpose(1, 0, 2).reshape(m, -1)) / sigma
    assert np.mean(white**2) == pytest.approx(1.0, abs=0.1)
