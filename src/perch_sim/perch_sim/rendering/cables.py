"""Rendering of cables by the distance between pixel rays and cable axes, not by polygons, so that the width is correct
even where a wire is thinner than a pixel.

For a straight piece with the point p and the unit direction l (camera at the origin), the ray r passes the axis at
the signed distance s = r . (p x l) / |r x l|. The ray meets the cylinder if |s| < radius; the share of a pixel that it
covers follows from s and from the local scale across the wire [px/m].
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from perch_core.camera import Camera
from perch_sim.rendering.scene import CableCurve

SPACING = 0.1  # of the points along a cable; straighter than that no cable is drawn [m]
PIECE = 12.0  # aimed length of a piece in the image [px]
MARGIN = 1.5  # around a piece: half a pixel of blurred edge, and rounding [px]
LUMA = np.array([0.299, 0.587, 0.114])


@dataclass(frozen=True, eq=False)
class _Pieces:
    """Straight pieces of one cable that may be in a camera's image.

    Attributes:
        ends: ends of the pieces in the image [px], shape (n, 2, 2).
        start_C, direction: a point on each axis [m] and its unit direction, shape (n, 3).
        length: [m], shape (n,).
        moment: start x direction [m], shape (n, 3).
        scale: pixels that a metre across the wire spans [px/m], shape (n,).
        first, last: whether a piece starts or ends the cable, shape (n,).
    """

    ends: np.ndarray
    start_C: np.ndarray
    direction: np.ndarray
    length: np.ndarray
    moment: np.ndarray
    scale: np.ndarray
    first: np.ndarray
    last: np.ndarray


class CablePainter:
    """Paints cables over an image of the faces; has no mutable state."""

    def __init__(self, cables: tuple[CableCurve, ...], camera: Camera) -> None:
        self.cables = tuple((_resample(cable.points_W), cable) for cable in cables)
        self.camera = camera
        u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
        rays = camera.unproject(np.stack([u, v], axis=-1)).reshape(-1, 3)
        self._rays = np.where(np.isfinite(rays), rays, 0.0).astype(np.float32)

    def distance(self, p_W: np.ndarray) -> float:
        """Return the distance of the nearest cable from a point in W [m]."""
        return min(float(np.linalg.norm(points_W - p_W, axis=1).min()) for points_W, _ in self.cables)

    def paint(self, image: np.ndarray, p_WC: np.ndarray, R_WC: np.ndarray, faces: np.ndarray, half: np.ndarray) -> None:
        """Paint every cable into the image, the farthest first.

        Args:
            image: uint8, shape (height, width) or (height, width, 3), changed in place.
            p_WC, R_WC: pose of the camera in W [m].
            faces: matrices of the faces that may hide cables, shape (n, 3, 3): see `visibility`.
            half: half extents of these faces, shape (n, 2) [m].
        """
        order = sorted(self.cables, key=lambda item: -np.linalg.norm(item[0] - p_WC, axis=1).min())
        for points_W, cable in order:
            pieces = self._pieces((points_W - p_WC) @ R_WC, cable.radius)
            if pieces is not None:
                self._paint(image, pieces, cable, faces, half)

    def _pieces(self, points_C: np.ndarray, radius: float) -> _Pieces | None:
        pixels, valid = self.camera.project(points_C)
        step = np.linalg.norm(np.diff(np.nan_to_num(pixels), axis=0), axis=1)
        count = np.floor(np.concatenate([[0.0], np.cumsum(step)]) / PIECE)
        kept = np.flatnonzero(np.diff(count, prepend=-1.0, append=np.inf)[: len(count)] > 0)
        kept = np.unique(np.concatenate([[0], kept, [len(count) - 1]]))
        a, b = kept[:-1], kept[1:]
        direction = points_C[b] - points_C[a]
        length = np.linalg.norm(direction, axis=1)
        direction /= length[:, None]
        scale = self._scale((points_C[a] + points_C[b]) / 2, direction)
        reach = radius * np.nan_to_num(scale) + MARGIN
        size = [self.camera.width, self.camera.height]
        low, high = np.minimum(pixels[a], pixels[b]), np.maximum(pixels[a], pixels[b])
        with np.errstate(invalid="ignore"):
            near = np.all((high > -reach[:, None]) & (low < size + reach[:, None]), axis=1)
        visible = np.flatnonzero(valid[a] & valid[b] & np.isfinite(scale) & near)
        if not len(visible):
            return None
        a, b, direction = a[visible], b[visible], direction[visible]
        return _Pieces(np.stack([pixels[a], pixels[b]], axis=1), points_C[a], direction, length[visible],
                       np.cross(points_C[a], direction), scale[visible], a == 0, b == len(points_C) - 1)

    def _scale(self, points_C: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """Return the pixels per metre across a wire, shape (n,): area scale of the image over its length scale along the wire."""
        jacobian = self.camera.project_jacobian(points_C)
        across = np.cross(points_C, direction)
        across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
        along_px = np.einsum("nij,nj->ni", jacobian, direction)
        across_px = np.einsum("nij,nj->ni", jacobian, across)
        area = np.abs(along_px[:, 0] * across_px[:, 1] - along_px[:, 1] * across_px[:, 0])
        return area / np.maximum(np.linalg.norm(along_px, axis=1), 1e-6)

    def _paint(self, image: np.ndarray, pieces: _Pieces, cable: CableCurve, faces: np.ndarray,
               half: np.ndarray) -> None:
        pixels, piece = self._band(pieces, cable.radius)
        rays = self._rays[pixels].astype(float)
        cosine = _dot(rays, pieces.direction[piece])
        sine2 = np.maximum(1.0 - cosine**2, 1e-12)
        offset = _dot(rays, pieces.moment[piece]) / np.sqrt(sine2)
        width, centre = cable.radius * pieces.scale[piece], offset * pieces.scale[piece]
        share = np.minimum(np.minimum(width, centre + 0.5) - np.maximum(-width, centre - 0.5), 1.0)
        covered = np.flatnonzero(share > 0.004)
        rays, cosine, piece = rays[covered], cosine[covered], piece[covered]
        toward = _dot(rays, pieces.start_C[piece])
        # the axis' nearest point: so far from the piece's start, and so far along the ray [m]
        along = (cosine * toward - _dot(pieces.direction, pieces.start_C)[piece]) / sine2[covered]
        distance = toward + along * cosine
        shown = distance > 0
        shown &= ~(pieces.first[piece] & (along < 0)) & ~(pieces.last[piece] & (along > pieces.length[piece]))
        shown &= ~_hidden(rays, distance, faces, half)
        covered = covered[shown]
        self._blend(image, pixels[covered], share[covered], _shade(offset[covered] / cable.radius, width[covered]),
                    np.array(cable.colour, dtype=float))

    def _band(self, pieces: _Pieces, radius: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the flat indices of the pixels around the pieces, and the piece to which each belongs."""
        ends = np.clip(np.rint(pieces.ends), -8000, 8000).astype(int)
        length = np.linalg.norm(pieces.ends[:, 1] - pieces.ends[:, 0], axis=1)
        bend = length**2 / (8 * self.camera.fx)  # what a fisheye makes of a straight piece
        reach = np.ceil(np.minimum(radius * pieces.scale + bend + MARGIN, 2000)).astype(int)
        left, top = np.maximum((ends - reach[:, None, None]).min(axis=(0, 1)), 0)
        right, bottom = np.minimum((ends + reach[:, None, None]).max(axis=(0, 1)) + 1, (self.camera.width, self.camera.height))
        if right <= left or bottom <= top:  # all of it is beside the image
            return np.zeros(0, int), np.zeros(0, int)
        label = np.zeros((bottom - top, right - left), np.int32)
        for number, (pair, thick) in enumerate(zip((ends - [left, top]).tolist(), (2 * reach + 1).tolist()), start=1):
            cv2.line(label, pair[0], pair[1], number, thick)
        rows, cols = np.divmod(np.flatnonzero(label.ravel() != 0), label.shape[1])
        return (rows + top) * self.camera.width + cols + left, label[rows, cols] - 1

    def _blend(self, image: np.ndarray, pixels: np.ndarray, share: np.ndarray, shade: np.ndarray,
               colour: np.ndarray) -> None:
        flat = image.reshape(self.camera.height * self.camera.width, -1)
        own = shade[:, None] * (colour if flat.shape[1] == 3 else np.array([colour @ LUMA]))
        mixed = flat[pixels] * (1.0 - share[:, None]) + own * share[:, None]
        flat[pixels] = np.rint(mixed).astype(np.uint8)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("ij,ij->i", a, b)


def _resample(points_W: np.ndarray) -> np.ndarray:
    """Return the polyline with points at most SPACING apart."""
    points_W = np.asarray(points_W, dtype=float)
    count = np.maximum(np.ceil(np.linalg.norm(np.diff(points_W, axis=0), axis=1) / SPACING).astype(int), 1)
    parts = [a + np.arange(n)[:, None] / n * (b - a) for a, b, n in zip(points_W[:-1], points_W[1:], count)]
    return np.vstack([*parts, points_W[-1:]])


def _hidden(rays: np.ndarray, distance: np.ndarray, faces: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Return whether a face is in front of the points at these distances along unit rays, shape (n,)."""
    hidden = np.zeros(len(rays), dtype=bool)
    for (half_u, half_v), M in zip(half, faces.astype(float)):
        inverse = rays @ M[2]
        nearer = np.flatnonzero(inverse * distance > 1.0 + 1e-3)
        if len(nearer) and np.isfinite(half_u):
            u, v = M[:2] @ rays[nearer].T
            inverse = inverse[nearer]
            nearer = nearer[(np.abs(u) <= half_u * inverse) & (np.abs(v) <= half_v * inverse)]
        hidden[nearer] = True
    return hidden


def _shade(offset: np.ndarray, width: np.ndarray) -> np.ndarray:
    """Return the brightness across a round wire, at the share `offset` in [-1, 1] of its radius; uniform for thin wires."""
    profile = 0.6 + 0.4 * np.sqrt(np.clip(1.0 - offset**2, 0.0, 1.0))
    thick = np.clip(width - 0.5, 0.0, 1.0)
    return thick * profile + (1.0 - thick) * (0.6 + 0.1 * np.pi)  # the profile's mean
