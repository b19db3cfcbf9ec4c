"""One image with the textures of all faces at all resolutions, so that one `cv2.remap` renders cells of all faces.

Levels are a factor sqrt(2) apart: half as much blur, or aliasing, as with the usual factor of two.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from perch_sim.rendering import textures
from perch_sim.rendering.scene import Face, Scene

BORDER = 4  # texels repeated around a texture, so that interpolation never meets the neighbour
LEVELS_PER_OCTAVE = 2
SHELF = 8192  # width of the atlas, at least; OpenCV's remap takes sides below 32768
VOID = 60  # grey level where no face is hit: a camera that left the room


@dataclass(frozen=True, eq=False)
class Atlas:
    """Textures of all faces at all resolutions.

    Attributes:
        image: uint8, shape (rows, cols).
        affine: float32, shape (faces, levels, 4): (sx, ox, sy, oy) with column = sx u + ox and row = sy v + oy,
            u and v metres right and up from the face's centre.
        levels: number of levels of each face, shape (faces,).
        void: column and row of the texel for rays that hit no face.
    """

    image: np.ndarray
    affine: np.ndarray
    levels: np.ndarray
    void: tuple[float, float]


def _levels(texture: np.ndarray) -> list[np.ndarray]:
    """Return the texture at scales 2^(-l/2); from l = 2 on, each level is level l - 2, halved."""
    rows, cols = texture.shape
    out = [texture]
    while min(rows, cols) * 2 ** (-len(out) / LEVELS_PER_OCTAVE) >= 4:
        scale = 2 ** (-len(out) / LEVELS_PER_OCTAVE)
        source = out[max(0, len(out) - LEVELS_PER_OCTAVE)]
        size = (max(1, round(cols * scale)), max(1, round(rows * scale)))
        out.append(cv2.resize(source, size, interpolation=cv2.INTER_AREA))
    return out


def face_texture(scene: Scene, number: int, face: Face) -> np.ndarray:
    """Return the full-resolution texture of `scene.faces()[number]`, uint8: rows run along -up, columns along right."""
    rng = np.random.default_rng([scene.seed, number])
    if face.kind == "pad" and scene.board is not None:
        return textures.pad(scene.board, face.texel, rng)
    cols, rows = (max(8, round(2 * half / face.texel)) for half in face.half)
    return textures.blobs(rng, rows, cols, face.texel, scene.contrast)


@lru_cache(maxsize=2)
def build_atlas(scene: Scene) -> Atlas:
    """Draw and pack the textures of a scene; both cameras of a vehicle share the result. Two scenes are cached, 50 MB each."""
    faces = scene.faces()
    tiles = []
    for number, face in enumerate(faces):
        tiles += [(number, level, tile) for level, tile in enumerate(_levels(face_texture(scene, number, face)))]
    count = np.bincount([number for number, _, _ in tiles])
    affine = np.zeros((len(faces), count.max(), 4), np.float32)
    tiles.append((-1, 0, np.full((8, 8), VOID, np.uint8)))
    places, shape = _pack([tile.shape for _, _, tile in tiles])
    image = np.zeros(shape, np.uint8)  # pages between the tiles are never touched
    void = (0.0, 0.0)
    for (number, level, tile), (x, y) in zip(tiles, places):
        rows, cols = tile.shape
        framed = cv2.copyMakeBorder(tile, BORDER, BORDER, BORDER, BORDER, cv2.BORDER_REPLICATE)
        image[y: y + rows + 2 * BORDER, x: x + cols + 2 * BORDER] = framed
        if number < 0:
            void = (x + BORDER + cols / 2, y + BORDER + rows / 2)
            continue
        half_u, half_v = faces[number].half
        affine[number, level] = (cols / (2 * half_u), x + BORDER + cols / 2 - 0.5,
                                 -rows / (2 * half_v), y + BORDER + rows / 2 - 0.5)
    return Atlas(image, affine, count, void)


def _pack(shapes: list[tuple[int, int]]) -> tuple[list[tuple[int, int]], tuple[int, int]]:
    """Return the positions (x, y) of framed tiles on shelves, tallest first, and the shape of the atlas.

    Filled in the order of height, shelves of the width W need at most the height 2 A / W + h for tiles of the area A and heights
    up to h. All levels of a scene's faces together have up to 98e6 texels, and sides up to 16,000 (see `scene`): with W >= 2 h
    and W >= SHELF, both sides of the atlas are below 32768.
    """
    width = max(SHELF, *(max(cols + 2 * BORDER, 2 * (rows + 2 * BORDER)) for rows, cols in shapes))
    places: list[tuple[int, int]] = [(0, 0)] * len(shapes)
    x = y = shelf = 0
    for index in sorted(range(len(shapes)), key=lambda i: -shapes[i][0]):
        rows, cols = (side + 2 * BORDER for side in shapes[index])
        if x + cols > width:
            x, y, shelf = 0, y + shelf, 0
        places[index] = (x, y)
        x, shelf = x + cols, max(shelf, rows)
    return places, (y + shelf, width)
