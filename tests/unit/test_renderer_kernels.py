"""The renderer's compiled loops against the same formulas in numpy."""

import numpy as np
import pytest

from oracles import renderer as plain
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
    plain.uniform_samples(M, affine[:40], corners, cells, face, weights, *theirs)
    np.testing.assert_allclose(ours, theirs, rtol=1e-4, atol=1e-2)  # [texel]; the sums are grouped differently


@pytest.mark.parametrize("half", [(np.inf, np.inf), (0.4, 0.3)])
def test_cells_in_which_faces_meet(world, half):
    rng, M, affine, corners = world
    half = np.array(half, np.float32)
    cells, weights = rng.permutation(CELLS)[:50], sample_weights(2)
    ours, theirs = (np.full((3, 50, weights.shape[1]), 1e-6, np.float32) for _ in range(2))
    for face in range(FACES):
        rows = np.flatnonzero(rng.random(50) < 0.7)
        for draw, out in ((kernels.nearer_samples, ours), (plain.nearer_samples, theirs)):
            draw(M[face], half, affine[rows], corners, cells, rows, weights, *out)
    agree = np.isclose(ours, theirs, rtol=1e-4, atol=1e-2).all(axis=0)
    assert agree.mean() > 0.999  # the odd sample lies on an edge
    assert 0.1 < (ours[0] > 1e-6).mean()


def test_classified_cells(world):
    rng, M, _, _ = world
    nodes = np.concatenate([rng.uniform(-0.5, 0.5, (2, 9 * 7)), np.ones((1, 9 * 7))]).astype(np.float32)
    index = np.arange(9 * 7).reshape(7, 9)
    corner_nodes = np.stack([index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]], axis=-1).reshape(-1, 4)
    half, bounded = np.full((FACES, 2), np.inf, np.float32), np.array([-1, 0, -1, 1, -1])
    half[[1, 3]] = 0.2
    crossed = rng.random((2, len(corner_nodes))) < 0.2
    found = []
    for draw in (kernels.classify, plain.classify):
        out = np.empty(len(corner_nodes), np.int64), np.empty(len(corner_nodes), bool), crossed.copy()
        draw(M, half, bounded, nodes, corner_nodes, *out)
        found.append(out)
    for ours, theirs in zip(*found):
        np.testing.assert_array_equal(ours, theirs)
    first, uniform, shown = found[0]
    assert len(set(first)) > 1 and 0 < shown[0].sum() < len(first) and not (uniform & crossed.any(axis=0)).any()


def test_levels_of_the_atlas(world):
    rng, M, _, _ = world
    centres = np.concatenate([rng.uniform(-0.5, 0.5, (CELLS, 2)), np.ones((CELLS, 1))], axis=1).astype(np.float32)
    cells, face = rng.permutation(CELLS)[:40], rng.integers(0, FACES, 40)
    table, levels = rng.normal(size=(FACES, 9, 4)).astype(np.float32), np.array([9, 4, 9, 1, 9])
    angle, texel = np.full(CELLS, 0.004, np.float32), rng.uniform(0.0005, 0.02, FACES)
    ours, theirs = np.empty((2, 40, 4), np.float32)
    for draw, out in ((kernels.affine_of_cells, ours), (plain.affine_of_cells, theirs)):
        draw(M, np.full(FACES, 1.5), texel, centres, angle, table, levels, cells, face, 2, 2, out)
    np.testing.assert_array_equal(ours, theirs)
    assert len(np.unique(ours[:, 0])) > 3


def test_faces_behind(world):
    rng, M, _, corners = world
    room, cells = np.array([0, 2, 3]), rng.permutation(CELLS)[:40]
    ours, theirs = np.zeros((2, 3, 40), bool)
    kernels.faces_behind(M, room, corners, cells, ours)
    plain.faces_behind(M, room, corners, cells, theirs)
    np.testing.assert_array_equal(ours, theirs)
    assert ours.any(axis=0).all() and (ours.sum(axis=0) > 1).any()


@pytest.mark.parametrize("samples", [1, 4, 9])
def test_placed_texels(samples):
    rng = np.random.default_rng(5)
    texels, cells = rng.integers(0, 256, (6, 64 * samples), np.uint8), np.array([7, 0, 3, 11, 5, 8])
    ours, theirs = np.zeros((2, 3, 8, 4, 8), np.uint8)
    kernels.place_texels(texels, cells, samples, ours)
    plain.place_texels(texels, cells, samples, theirs)
    np.testing.assert_array_equal(ours, theirs)
    assert ours[1, 2, 3, 5] == round(texels[0, 21 * samples: 22 * samples].mean() + 1e-9)
