"""The renderer's inner loops over samples, compiled.

In numpy each arithmetic operation is a pass over all samples of all cells; compiled, a sample is finished in registers, and
without the interpreter lock, so that the drawing threads do not hold up the node's steps. The functions in numpy serve
where numba does not, and tell in tests whether the kernels are right.
"""

from __future__ import annotations

import numpy as np

from perch_core.jit import COMPILED, compiled


@compiled(nogil=True)
def _uniform_samples(M: np.ndarray, affine: np.ndarray, corners: np.ndarray, cells: np.ndarray, face: np.ndarray,
                    weights: np.ndarray, x: np.ndarray, y: np.ndarray) -> None:
    q = np.empty((3, 4), np.float32)
    for i in range(len(cells)):
        m, rays = M[face[i]], corners[cells[i]]
        for c in range(4):
            inverse = m[2, 0] * rays[0, c] + m[2, 1] * rays[1, c] + m[2, 2] * rays[2, c]
            u = m[0, 0] * rays[0, c] + m[0, 1] * rays[1, c] + m[0, 2] * rays[2, c]
            v = m[1, 0] * rays[0, c] + m[1, 1] * rays[1, c] + m[1, 2] * rays[2, c]
            q[0, c] = affine[i, 0] * u + affine[i, 1] * inverse
            q[1, c] = affine[i, 2] * v + affine[i, 3] * inverse
            q[2, c] = inverse
        a0, a1, a2, a3 = q[0]
        b0, b1, b2, b3 = q[1]
        c0, c1, c2, c3 = q[2]
        one = np.float32(1.0)
        for s in range(weights.shape[1]):
            w0, w1, w2, w3 = weights[0, s], weights[1, s], weights[2, s], weights[3, s]
            scale = one / (c0 * w0 + c1 * w1 + c2 * w2 + c3 * w3)
            x[i, s] = (a0 * w0 + a1 * w1 + a2 * w2 + a3 * w3) * scale
            y[i, s] = (b0 * w0 + b1 * w1 + b2 * w2 + b3 * w3) * scale


@compiled(nogil=True)
def _nearer_samples(m: np.ndarray, half: np.ndarray, affine: np.ndarray, corners: np.ndarray, cells: np.ndarray,
                   rows: np.ndarray, weights: np.ndarray, nearest: np.ndarray, x: np.ndarray, y: np.ndarray) -> None:
    one = np.float32(1.0)
    big = np.float32(1e30)
    half_u, half_v = min(half[0], big), min(half[1], big)
    q = np.empty((3, 4), np.float32)
    for i in range(len(rows)):
        rays = corners[cells[rows[i]]]
        for k in range(3):
            for c in range(4):
                q[k, c] = m[k, 0] * rays[0, c] + m[k, 1] * rays[1, c] + m[k, 2] * rays[2, c]
        a0, a1, a2, a3 = q[0]
        b0, b1, b2, b3 = q[1]
        c0, c1, c2, c3 = q[2]
        sx, ox, sy, oy = affine[i]
        near, to_x, to_y = nearest[rows[i]], x[rows[i]], y[rows[i]]
        for s in range(weights.shape[1]):
            w0, w1, w2, w3 = weights[0, s], weights[1, s], weights[2, s], weights[3, s]
            inverse = c0 * w0 + c1 * w1 + c2 * w2 + c3 * w3
            if inverse > near[s]:
                u = a0 * w0 + a1 * w1 + a2 * w2 + a3 * w3
                v = b0 * w0 + b1 * w1 + b2 * w2 + b3 * w3
                if abs(u) <= half_u * inverse and abs(v) <= half_v * inverse:
                    scale = one / inverse
                    near[s] = inverse
                    to_x[s] = sx * (u * scale) + ox
                    to_y[s] = sy * (v * scale) + oy


def uniform_samples_numpy(M: np.ndarray, affine: np.ndarray, corners: np.ndarray, cells: np.ndarray, face: np.ndarray,
                          weights: np.ndarray, x: np.ndarray, y: np.ndarray) -> None:
    """Atlas coordinates of the samples of cells that show one face each.

    Args:
        M: of the faces, see `View`, float32, shape (faces, 3, 3).
        affine: (sx, ox, sy, oy) of each cell's atlas level, shape (n, 4).
        corners: rays of the corners of all cells, float32, shape (cells, 3, 4).
        cells, face: the cells to draw and the face that each shows, shapes (n,).
        weights: of the corners at the samples, float32, shape (4, samples).
        x, y: filled with the coordinates [texel], float32, shape (n, samples).
    """
    sx, ox, sy, oy = affine.T[..., None]
    m = M[face]
    to_atlas = np.stack([sx * m[:, 0] + ox * m[:, 2], sy * m[:, 1] + oy * m[:, 2], m[:, 2]], axis=1)
    q = np.matmul(to_atlas, corners[cells]).transpose(1, 0, 2)  # (3, cells, 4)
    u, v, inverse = np.ascontiguousarray(q) @ weights
    np.divide(u, inverse, out=x)
    np.divide(v, inverse, out=y)


def nearer_samples_numpy(m: np.ndarray, half: np.ndarray, affine: np.ndarray, corners: np.ndarray, cells: np.ndarray,
                         rows: np.ndarray, weights: np.ndarray, nearest: np.ndarray, x: np.ndarray, y: np.ndarray) -> None:
    """Give one face the samples in which it is in front of the faces drawn so far.

    Args:
        m: of the face, see `View`, float32, shape (3, 3).
        half: its half extents [m], infinite where it is not bounded, float32, shape (2,).
        affine: (sx, ox, sy, oy) of the atlas level in each row, shape (r, 4).
        corners: rays of the corners of all cells, float32, shape (cells, 3, 4).
        cells: the cells to draw, shape (n,).
        rows: those of `cells` in which the face may show, shape (r,).
        weights: of the corners at the samples, float32, shape (4, samples).
        nearest, x, y: inverse range [1/m] and atlas coordinates [texel] of what is in front, float32, shape (n, samples);
            changed where the face wins.
    """
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


uniform_samples = _uniform_samples if COMPILED else uniform_samples_numpy
nearer_samples = _nearer_samples if COMPILED else nearer_samples_numpy
