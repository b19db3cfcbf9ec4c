"""The renderer's inner loops over cells and samples, compiled.

In numpy each arithmetic operation is a pass over all samples of all cells; compiled, a sample is computed in registers, and
without the interpreter lock, so that rendering threads of one process do not block each other. A test compares the loops with
plain numpy (tests/oracles/renderer.py).
"""

from __future__ import annotations

import numpy as np

from perch_core.jit import compiled


@compiled(nogil=True)
def classify(M: np.ndarray, half: np.ndarray, bounded: np.ndarray, nodes: np.ndarray, corner_nodes: np.ndarray,
             first: np.ndarray, uniform: np.ndarray, shown: np.ndarray) -> None:
    """Determine the face that each cell shows.

    Args:
        M: matrices of the faces, see `View`, float32, shape (faces, 3, 3).
        half: half extents, infinite where a face is not bounded, float32, shape (faces, 2) [m].
        bounded: row in `shown` of each face, -1 for those without edges, shape (faces,).
        nodes: rays at the corners of cells, float32, shape (3, n).
        corner_nodes: each cell's corners, shape (cells, 4).
        first: filled with the face at each cell's first corner, -1: none, shape (cells,).
        uniform: filled with whether the cell shows that face alone, shape (cells,) bool.
        shown: initially the cells that an edge of each bounded face crosses; cells in which a corner's ray hits the face
            are added, shape (bounded faces, cells) bool.
    """
    count = nodes.shape[1]
    winner = np.empty(count, np.int32)
    hits = np.zeros((len(shown), count), np.bool_)
    for i in range(count):
        x, y, z = nodes[0, i], nodes[1, i], nodes[2, i]
        nearest, winner[i] = np.float32(0.0), -1
        for f in range(len(M)):
            inverse = M[f, 2, 0] * x + M[f, 2, 1] * y + M[f, 2, 2] * z
            if inverse > 1e-6:
                row = bounded[f]
                if row >= 0:
                    u = M[f, 0, 0] * x + M[f, 0, 1] * y + M[f, 0, 2] * z
                    v = M[f, 1, 0] * x + M[f, 1, 1] * y + M[f, 1, 2] * z
                    if abs(u) > half[f, 0] * inverse or abs(v) > half[f, 1] * inverse:
                        continue
                    hits[row, i] = True
                if inverse > nearest:
                    nearest, winner[i] = inverse, f
    for cell in range(len(first)):
        a, b, c, d = corner_nodes[cell]
        one = winner[a]
        first[cell] = one
        alike = winner[b] == one and winner[c] == one and winner[d] == one
        for row in range(len(shown)):
            if shown[row, cell]:
                alike = False
            elif hits[row, a] or hits[row, b] or hits[row, c] or hits[row, d]:
                shown[row, cell] = True
        uniform[cell] = alike


@compiled(nogil=True)
def affine_of_cells(M: np.ndarray, distance: np.ndarray, texel: np.ndarray, centres: np.ndarray, pixel_angle: np.ndarray,
                    table: np.ndarray, levels: np.ndarray, cells: np.ndarray, face: np.ndarray, supersampling: int,
                    levels_per_octave: int, out: np.ndarray) -> None:
    """Select the atlas level for each cell whose texels are about as large as a sample's footprint on the face.

    Args:
        M, distance: matrices and distances of the faces, see `View`.
        texel: size of the faces' texels at level 0 [m], shape (faces,).
        centres, pixel_angle: of the grid's cells, see `CellGrid`.
        table, levels: `Atlas.affine`, `Atlas.levels`.
        cells, face: the cells to draw and the face that each shows, shapes (n,).
        supersampling: samples per pixel and direction.
        levels_per_octave: `LEVELS_PER_OCTAVE` of the atlas.
        out: filled with (sx, ox, sy, oy), float32, shape (n, 4).
    """
    for i in range(len(cells)):
        f, cell = face[i], cells[i]
        inverse = max(M[f, 2, 0] * centres[cell, 0] + M[f, 2, 1] * centres[cell, 1] + M[f, 2, 2] * centres[cell, 2], 1e-3)
        slant = min(max(inverse * distance[f], 0.02), 1.0)
        footprint = pixel_angle[cell] / (inverse * texel[f] * np.sqrt(slant))
        level = round(levels_per_octave * np.log2(footprint / supersampling))
        out[i] = table[f, int(min(max(level, 0), levels[f] - 1))]


@compiled(nogil=True)
def faces_behind(M: np.ndarray, room: np.ndarray, corners: np.ndarray, cells: np.ndarray, shown: np.ndarray) -> None:
    """Find the faces of the room that are behind everything else, cell by cell.

    Args:
        M: matrices of the faces, see `View`, float32, shape (faces, 3, 3).
        room: the faces without edges, shape (r,).
        corners: rays of the corners of all cells, float32, shape (cells, 3, 4).
        cells: the cells to examine, shape (n,).
        shown: set where a corner of the cell shows the face, shape (r, n) bool.
    """
    for i in range(len(cells)):
        rays = corners[cells[i]]
        for c in range(4):
            best, nearest = 0, np.float32(-np.inf)
            for k in range(len(room)):
                m = M[room[k], 2]
                inverse = m[0] * rays[0, c] + m[1] * rays[1, c] + m[2] * rays[2, c]
                if inverse > nearest:
                    best, nearest = k, inverse
            shown[best, i] = True


@compiled(nogil=True)
def place_texels(texels: np.ndarray, cells: np.ndarray, samples: int, image: np.ndarray) -> None:
    """Average texels per pixel and write them to the image's cells.

    Args:
        texels: uint8, shape (n, pixels of a cell * samples).
        cells: cells of the texels, shape (n,).
        samples: number of samples per pixel.
        image: uint8, shape (rows, size, columns, size) of cells.
    """
    size, cols = image.shape[1], image.shape[2]
    for i in range(len(cells)):
        row, col = cells[i] // cols, cells[i] % cols
        for a in range(size):
            if samples == 1:
                for b in range(size):
                    image[row, a, col, b] = texels[i, a * size + b]
                continue
            for b in range(size):
                first = (a * size + b) * samples
                total = samples // 2
                for s in range(first, first + samples):
                    total += texels[i, s]
                image[row, a, col, b] = total // samples


@compiled(nogil=True)
def uniform_samples(M: np.ndarray, affine: np.ndarray, corners: np.ndarray, cells: np.ndarray, face: np.ndarray,
                   weights: np.ndarray, x: np.ndarray, y: np.ndarray) -> None:
    """Compute the atlas coordinates of the samples of cells that show one face each.

    Args:
        M: matrices of the faces, see `View`, float32, shape (faces, 3, 3).
        affine: (sx, ox, sy, oy) of each cell's atlas level, shape (n, 4).
        corners: rays of the corners of all cells, float32, shape (cells, 3, 4).
        cells, face: the cells to draw and the face that each shows, shapes (n,).
        weights: of the corners at the samples, float32, shape (4, samples).
        x, y: filled with the coordinates [texel], float32, shape (n, samples).
    """
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
def nearer_samples(m: np.ndarray, half: np.ndarray, affine: np.ndarray, corners: np.ndarray, cells: np.ndarray,
                  rows: np.ndarray, weights: np.ndarray, nearest: np.ndarray, x: np.ndarray, y: np.ndarray) -> None:
    """Assign to one face the samples in which it is in front of the faces processed so far.

    Args:
        m: matrix of the face, see `View`, float32, shape (3, 3).
        half: its half extents [m], infinite where it is not bounded, float32, shape (2,).
        affine: (sx, ox, sy, oy) of the atlas level in each row, shape (r, 4).
        corners: rays of the corners of all cells, float32, shape (cells, 3, 4).
        cells: the cells to draw, shape (n,).
        rows: indices into `cells` of those in which the face may be visible, shape (r,).
        weights: of the corners at the samples, float32, shape (4, samples).
        nearest, x, y: inverse range [1/m] and atlas coordinates [texel] of the front face, float32, shape (n, samples);
            changed where this face is in front.
    """
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


def texels_per_pixel(M: np.ndarray, distance: np.ndarray, texel: np.ndarray, centres: np.ndarray, pixel_angle: np.ndarray,
                     cells: np.ndarray, face: np.ndarray) -> np.ndarray:
    """Return the geometric mean of a pixel's footprint on faces [texel] at cell centres, (n,); arguments as `affine_of_cells`."""
    inverse = np.maximum(np.einsum("ij,ij->i", M[face, 2], centres[cells]), 1e-3)
    slant = np.clip(inverse * distance[face], 0.02, 1.0)  # cosine between ray and normal
    return pixel_angle[cells] / (inverse * texel[face] * np.sqrt(slant))
