"""The loops of the renderer in numpy, with the arguments of `perch_sim.rendering.kernels`."""

from __future__ import annotations

import numpy as np

from perch_sim.rendering.kernels import texels_per_pixel


def classify(M, half, bounded, nodes, corner_nodes, first, uniform, shown):
    q = (M.reshape(-1, 3) @ nodes).reshape(len(M), 3, nodes.shape[1])
    inverse = q[:, 2]
    hit = inverse > 1e-6
    edged = np.flatnonzero(bounded >= 0)
    hit[edged] &= np.all(np.abs(q[edged, :2]) <= half[edged][:, :, None] * inverse[edged][:, None, :], axis=1)
    inverse = np.where(hit, inverse, -1.0)
    winner = np.where(inverse.max(axis=0) > 0, inverse.argmax(axis=0), -1)[corner_nodes]
    first[:] = winner[:, 0]
    uniform[:] = (winner == first[:, None]).all(axis=1) & ~shown.any(axis=0)
    shown[bounded[edged]] |= hit[edged][:, corner_nodes].any(axis=2)


def affine_of_cells(M, distance, texel, centres, pixel_angle, table, levels, cells, face, supersampling, levels_per_octave, out):
    footprint = texels_per_pixel(M, distance, texel, centres, pixel_angle, cells, face) / supersampling
    level = np.rint(levels_per_octave * np.log2(footprint))
    out[:] = table[face, np.clip(level, 0, levels[face] - 1).astype(int)]


def faces_behind(M, room, corners, cells, shown):
    behind = (M[room, 2] @ corners[cells]).argmax(axis=1)  # (n, 4)
    shown[behind, np.arange(len(cells))[:, None]] = True


def place_texels(texels, cells, samples, image):
    size, cols = image.shape[1], image.shape[2]
    total = texels.reshape(len(cells), size, size, samples).sum(axis=-1, dtype=np.int64)
    row, col = np.divmod(cells, cols)
    image[row, :, col, :] = (total + samples // 2) // samples


def uniform_samples(M, affine, corners, cells, face, weights, x, y):
    sx, ox, sy, oy = affine.T[..., None]
    m = M[face]
    to_atlas = np.stack([sx * m[:, 0] + ox * m[:, 2], sy * m[:, 1] + oy * m[:, 2], m[:, 2]], axis=1)
    q = np.matmul(to_atlas, corners[cells]).transpose(1, 0, 2)  # (3, cells, 4)
    u, v, inverse = np.ascontiguousarray(q) @ weights
    np.divide(u, inverse, out=x)
    np.divide(v, inverse, out=y)


def nearer_samples(m, half, affine, corners, cells, rows, weights, nearest, x, y):
    u, v, inverse = np.ascontiguousarray(np.matmul(m, corners[cells[rows]]).transpose(1, 0, 2)) @ weights
    before = nearest[rows]
    wins = inverse > before
    if np.isfinite(half[0]):
        wins &= (np.abs(u) <= half[0] * inverse) & (np.abs(v) <= half[1] * inverse)
    sx, ox, sy, oy = affine.T[..., None]
    np.copyto(before, inverse, where=wins)
    range_ = 1.0 / before  # of this face where it wins; elsewhere the value is not used
    x[rows] = np.where(wins, sx * (u * range_) + ox, x[rows])
    y[rows] = np.where(wins, sy * (v * range_) + oy, y[rows])
    nearest[rows] = before
