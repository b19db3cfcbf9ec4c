"""Rasteriser for the faces of a scene as seen from one camera pose: texture look-ups, cell by cell.

In cells that show one face, one sample per pixel is taken from the atlas level that fits the distance; in cells of the
pad, several; in cells where faces meet, the front face is determined for every sample.
"""

from __future__ import annotations

import cv2
import numpy as np

from perch_core.camera import Camera, Region
from perch_sim.rendering.atlas import LEVELS_PER_OCTAVE, Atlas
from perch_sim.rendering.grid import CELL, CellGrid, sample_weights
from perch_sim.rendering.kernels import affine_of_cells, faces_behind, nearer_samples, place_texels, texels_per_pixel, uniform_samples
from perch_sim.rendering.visibility import FaceArrays, View, classify_view

MIXED_SUPERSAMPLING = 2  # where faces meet, in each direction
PAD_SUPERSAMPLING = 4  # of the tags, in each direction
REMAP_SIDE = 32_000  # OpenCV's remap takes and gives images with sides below 32768: so many cells at once
FINE_SAMPLES = 400_000  # the tags take fewer samples per pixel when they fill the image


class Rasterizer:
    """Renders the flat faces of a scene for one camera; has no mutable state."""

    def __init__(self, faces: FaceArrays, atlas: Atlas, camera: Camera, grid: CellGrid) -> None:
        self.faces, self.atlas, self.camera, self.grid = faces, atlas, camera, grid
        self._void = int(atlas.image[int(atlas.void[1]), int(atlas.void[0])])

    def draw(self, p_WC: np.ndarray, R_WC: np.ndarray, shift_W: np.ndarray, region: Region) -> np.ndarray:
        """Return grey levels under full light, before the optics, uint8, shape (height, width); undefined outside the region.

        Args:
            p_WC, R_WC: pose of the camera in W [m].
            shift_W: displacement of the moving faces [m], shape (3,).
            region: rows and columns to draw.
        """
        grid, faces = self.grid, self.faces
        view = classify_view(faces, grid, self.camera, p_WC, R_WC, shift_W)
        first, uniform = view.first, view.uniform
        fine_face = np.zeros(len(faces.fine) + 1, dtype=bool)
        fine_face[:-1] = faces.fine  # the last entry answers for the winner -1
        visible = ~grid.blind & (first >= 0)
        fine = uniform & fine_face[first]
        mixed = ~uniform & ~grid.blind
        tagged = mixed & view.shown[faces.fine[faces.bounded]].any(axis=0)
        supersampling = self._fine_supersampling(view, np.flatnonzero((fine & visible) | tagged))
        requested = grid.cells_in(region)
        image = np.empty((grid.rows, CELL, grid.cols, CELL), np.uint8)
        self._draw_uniform(image, view, np.flatnonzero(uniform & visible & ~fine & requested), first, 1)
        self._draw_uniform(image, view, np.flatnonzero(fine & visible & requested), first, supersampling)
        self._draw_mixed(image, view, np.flatnonzero(mixed & ~tagged & requested), MIXED_SUPERSAMPLING)
        self._draw_mixed(image, view, np.flatnonzero(tagged & requested), max(supersampling, MIXED_SUPERSAMPLING))
        self._fill(image, np.flatnonzero(uniform & ~visible & requested), self._void)
        self._fill(image, np.flatnonzero(grid.blind & requested), 0)
        return image.reshape(grid.rows * CELL, grid.cols * CELL)[: self.camera.height, : self.camera.width]

    def _fill(self, image: np.ndarray, cells: np.ndarray, level: int) -> None:
        if len(cells):
            row, col = np.divmod(cells, self.grid.cols)
            image[row, :, col, :] = level

    def _fine_supersampling(self, view: View, cells: np.ndarray) -> int:
        """Return the samples per pixel and direction for the cells that show the pad."""
        if not len(cells):
            return 1
        pad = np.full(len(cells), np.flatnonzero(self.faces.fine)[0])
        footprint = float(np.median(texels_per_pixel(view.M, view.distance, self.faces.texel, self.grid.centres,
                                                     self.grid.pixel_angle, cells, pad)))
        wanted = np.ceil(PAD_SUPERSAMPLING * min(footprint, 1.0))
        affordable = int(np.sqrt(FINE_SAMPLES / (len(cells) * CELL**2)))
        return int(np.clip(wanted, 1, max(1, affordable)))

    def _affine(self, view: View, cells: np.ndarray, face: np.ndarray, supersampling: int) -> np.ndarray:
        """Return (sx, ox, sy, oy) of the atlas level that fits each cell, shape (cells, 4): see `Atlas.affine`."""
        out = np.empty((len(cells), 4), np.float32)
        affine_of_cells(view.M, view.distance, self.faces.texel, self.grid.centres, self.grid.pixel_angle, self.atlas.affine,
                        self.atlas.levels, cells, face, supersampling, LEVELS_PER_OCTAVE, out)
        return out

    def _draw_uniform(self, image: np.ndarray, view: View, cells: np.ndarray, first: np.ndarray,
                      supersampling: int) -> None:
        if not len(cells):
            return
        face = first[cells]
        weights = sample_weights(supersampling)
        x, y = np.empty((2, len(cells), weights.shape[1]), np.float32)
        uniform_samples(view.M, self._affine(view, cells, face, supersampling), self.grid.corners, cells, face, weights, x, y)
        self._look_up(image, cells, x, y, supersampling)

    def _draw_mixed(self, image: np.ndarray, view: View, cells: np.ndarray, supersampling: int) -> None:
        if not len(cells):
            return
        weights = sample_weights(supersampling)
        nearest = np.full((len(cells), weights.shape[1]), 1e-6, np.float32)  # inverse range of what is in front
        x = np.full_like(nearest, self.atlas.void[0])
        y = np.full_like(nearest, self.atlas.void[1])
        for face, rows in self._candidates(view, cells):
            affine = self._affine(view, cells[rows], np.full(len(rows), face), supersampling)
            nearer_samples(view.M[face], self.faces.half[face].astype(np.float32), affine, self.grid.corners, cells, rows,
                           weights, nearest, x, y)
        self._look_up(image, cells, x, y, supersampling)

    def _candidates(self, view: View, cells: np.ndarray) -> list[tuple[int, np.ndarray]]:
        """Return the faces that may be visible in mixed cells, each with the rows of `cells` where it may be."""
        behind = np.zeros((len(self.faces.room), len(cells)), bool)
        faces_behind(view.M, self.faces.room, self.grid.corners, cells, behind)
        found = [(int(face), np.flatnonzero(rows)) for face, rows in zip(self.faces.room, behind) if view.front[face]]
        found += [(int(face), np.flatnonzero(rows)) for face, rows in zip(self.faces.bounded, view.shown[:, cells])]
        return [(face, rows) for face, rows in found if len(rows)]

    def _look_up(self, image: np.ndarray, cells: np.ndarray, x: np.ndarray, y: np.ndarray,
                 supersampling: int) -> None:
        """Write the texels at x, y (cells, samples), averaged per pixel, to the image's cells."""
        for begin in range(0, len(cells), REMAP_SIDE):
            part = slice(begin, begin + REMAP_SIDE)
            texels = cv2.remap(self.atlas.image, x[part], y[part], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            place_texels(texels, cells[part], supersampling**2, image)
