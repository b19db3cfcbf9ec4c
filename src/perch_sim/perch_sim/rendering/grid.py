"""Division of an image into cells of 8 x 8 pixels, with the camera's rays at their corners.

Between the corners of a cell, rays are interpolated bilinearly. A face's texture coordinates are ratios of two
linear functions of the ray, so perspective is exact; the curvature of the lens's projection within 8 px is
neglected: 0.01 px RMS, 0.06 px in the corners of the snapdragon vehicle's image. (Rays of a pinhole camera
are scaled to z = 1, where interpolation is exact.)
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from perch_core.camera import Camera, PinholeCamera, Region

CELL = 8  # [px]


@lru_cache(maxsize=16)
def sample_weights(supersampling: int) -> np.ndarray:
    """Return the bilinear weights of a cell's corners (TL, TR, BL, BR) at its samples, float32, shape (4, 64 * ss^2).

    The order of the samples is by pixels (row by row), then by the ss x ss samples inside each pixel.
    """
    ss = supersampling
    at = ((np.arange(CELL)[:, None] + (np.arange(ss) + 0.5) / ss) / CELL)  # (pixel, sample)
    x = np.broadcast_to(at[None, :, None, :], (CELL, CELL, ss, ss)).ravel()
    y = np.broadcast_to(at[:, None, :, None], (CELL, CELL, ss, ss)).ravel()
    return np.stack([(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y]).astype(np.float32)


@dataclass(frozen=True, eq=False)
class CellGrid:
    """Rays of a camera at the corners of its cells.

    Attributes:
        rows, cols: number of cells.
        nodes: rays in C at the corners (unit; z = 1 for a pinhole), float32, shape (3, (rows + 1) * (cols + 1));
            zero where the projection has no ray.
        corner_nodes: indices into `nodes` of each cell's TL, TR, BL, BR corner, shape (rows * cols, 4).
        corners: rays of the corners of each cell, float32, shape (rows * cols, 3, 4).
        centres: rays through the centres of the cells, float32, shape (rows * cols, 3).
        blind: whether a corner of the cell is outside the lens's image, shape (rows * cols,).
        pixel_angle: angle that a pixel spans in each cell [rad], float32, shape (rows * cols,).
    """

    rows: int
    cols: int
    nodes: np.ndarray
    corner_nodes: np.ndarray
    corners: np.ndarray
    centres: np.ndarray
    blind: np.ndarray
    pixel_angle: np.ndarray

    def cells_in(self, region: Region) -> np.ndarray:
        """Return which cells a region of the image touches, shape (rows * cols,) bool."""
        touched = np.zeros((self.rows, self.cols), dtype=bool)
        touched[tuple(slice(part.start // CELL, -(-part.stop // CELL)) for part in region)] = True
        return touched.ravel()

    def cell_of(self, pixels: np.ndarray) -> np.ndarray:
        """Return the cells that contain pixels (n, 2), shape (n,); -1 outside the image and for NaN."""
        with np.errstate(invalid="ignore"):
            col = np.floor((pixels[:, 0] + 0.5) / CELL)
            row = np.floor((pixels[:, 1] + 0.5) / CELL)
            inside = (col >= 0) & (col < self.cols) & (row >= 0) & (row < self.rows)
            return np.where(inside, row * self.cols + col, -1).astype(int)


@lru_cache(maxsize=8)
def build_grid(camera: Camera) -> CellGrid:
    """Return the cells of a camera's image; cameras with the same intrinsics share them."""
    rows, cols = -(-camera.height // CELL), -(-camera.width // CELL)
    u, v = np.meshgrid(np.arange(cols + 1) * CELL - 0.5, np.arange(rows + 1) * CELL - 0.5)
    rays = camera.unproject(np.stack([u, v], axis=-1))
    valid = np.asarray(np.isfinite(rays).all(axis=-1))
    rays = np.where(valid[..., None], rays, 0.0)
    index = np.arange((rows + 1) * (cols + 1)).reshape(rows + 1, cols + 1)
    corner_nodes = np.stack([index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]], axis=-1).reshape(-1, 4)
    nodes = rays.reshape(-1, 3)
    corners = nodes[corner_nodes]  # (cells, 4, 3), unit rays
    across = (corners[:, 1] - corners[:, 0] + corners[:, 3] - corners[:, 2]) / 2
    along = (corners[:, 2] - corners[:, 0] + corners[:, 3] - corners[:, 1]) / 2
    solid_angle = np.linalg.norm(np.cross(across, along), axis=-1)
    centres = corners.mean(axis=1)
    if isinstance(camera, PinholeCamera):
        nodes, corners = nodes / nodes[:, 2:], corners / corners[..., 2:]
    return CellGrid(
        rows, cols, np.ascontiguousarray(nodes.T, np.float32), corner_nodes,
        np.ascontiguousarray(corners.transpose(0, 2, 1), np.float32), centres.astype(np.float32),
        np.asarray(~valid.reshape(-1)[corner_nodes].all(axis=1)),
        (np.sqrt(np.maximum(solid_angle, 1e-12)) / CELL).astype(np.float32),
    )
