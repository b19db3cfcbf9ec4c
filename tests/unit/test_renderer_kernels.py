"""The renderer's compiled loops against the same formulas in numpy."""

import numpy as np
import pytest

from perch_sim.rendering import kernels
from perch_sim.rendering.grid import sample_weights

CELLS, FACES = 60, 5


@pytest.fixture
def world():
    """Rays within 30 degrees of the axis, and faces at 1 to 5 m whose inverse range is positive on them."""
    rng = np.random.default_rng(3)
    corners = np.empty((CELLS, 3, 4), np.float32)
    corners[:, :2] = rng.uniform(-0.5, 0.5, (CELLS, 2, 4))
    corners[:, 2] = 1.0
    M = rng.uniform(-0.3, 0.3, (FACES, 3, 3)).astype(np.float32)
    M[:, 2, 2] = 1.0 / rng.uniform(1.0, 5.0, FACES) + 0.4
    affine = rng.uniform(50.0, 200.0, (CELLS, 4)).astype(np.float32)
    return rng, M, affine, corners


@pytest.mark.parametrize("supersampling", [1, 2, 4])
def test_uniform_cells(world, supersampling):
    rng, M, affine, corners = world
    cells, face = rng.permutation(CELLS)[:40], rng.integers(0, FACES, 40)
    weights = sample_weights(supersampling)
    ours, theirs = np.empty((2, 2, 40, weights.shape[1]), np.float32)
    kernels.uniform_samples(M, affine[:40], corners, cells, face, weights, *ours)
    kernels.uniform_samples_numpy(M, affine[:40], corners, cells, face, weights, *theirs)
    np.testing.assert_allclose(ours, theirs, rtol=1e-4, atol=1e-2)  # [texel]; the sums are grouped differently


@pytest.mark.parametrize("half", [(np.inf, np.inf), (0.4, 0.3)])
def test_cells_in_which_faces_meet(world, half):
    rng, M, affine, corners = world
    half = np.array(half, np.float32)
    cells, weights = rng.permutation(CELLS)[:50], sample_weights(2)
    ours, theirs = (np.full((3, 50, weights.shape[1]), 1e-6, np.float32) for _ in range(2))
    for face in range(FACES):
        rows = np.flatnonzero(rng.random(50) < 0.7)
        for draw, out in ((kernels.nearer_samples, ours), (kernels.nearer_samples_numpy, theirs)):
            draw(M[face], half, affine[rows], corners, cells, rows, weights, *out)
    agree = np.isclose(ours, theirs, rtol=1e-4, atol=1e-2).all(axis=0)
    assert agree.mean() > 0.999  # the odd sample lies on an edge
    assert 0.1 < (ours[0] > 1e-6).mean()
