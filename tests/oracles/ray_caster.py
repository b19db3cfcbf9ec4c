"""A slow, plain ray caster: every pixel is the mean of 8 x 8 rays, each followed to the nearest rectangle.

It shares with the renderer the description of the scene and the full-resolution textures, and nothing of how
they are drawn: no grid, no atlas, no levels, no interpolated rays.
"""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np

from perch_core.camera import Camera
from perch_sim.rendering.atlas import face_texture
from perch_sim.rendering.scene import Scene

RAYS = 8  # per pixel and direction


def cast(scene: Scene, camera: Camera, p_WC: np.ndarray, R_WC: np.ndarray,
         window: tuple[int, int, int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Grey levels under full light, before the optics.

    Args:
        scene: its cables are left out.
        camera: the projection.
        p_WC, R_WC: pose of the camera in W [m].
        window: first and last + 1 row, first and last + 1 column [px].

    Returns:
        Image of the window, float; and the face that most rays of each pixel hit, int (-1: none).
    """
    top, bottom, left, right = window
    at = (np.arange(RAYS) + 0.5) / RAYS - 0.5
    v, u = np.meshgrid((np.arange(top, bottom)[:, None] + at).ravel(), (np.arange(left, right)[:, None] + at).ravel(),
                       indexing="ij")
    rays_W = camera.unproject(np.stack([u, v], axis=-1)) @ R_WC.T
    rays_W = rays_W.reshape(-1, 3)
    nearest, grey, hit_face = np.full(len(rays_W), np.inf), np.zeros(len(rays_W)), np.full(len(rays_W), -1)
    for number, face in enumerate(scene.faces()):
        slope = rays_W @ face.normal_W
        facing = np.flatnonzero(slope < 0)
        t = (face.normal_W @ (face.centre_W - p_WC)) / slope[facing]
        near = (t > 0) & (t < nearest[facing])
        facing, t = facing[near], t[near]
        point = p_WC + t[:, None] * rays_W[facing] - face.centre_W
        x, y = point @ face.right_W, point @ face.up_W
        on = (np.abs(x) <= face.half[0] + 1e-6) & (np.abs(y) <= face.half[1] + 1e-6)
        hit, x, y = facing[on], x[on], y[on]
        if not len(hit):
            continue
        texture = _texture(scene, number)
        column = (x / face.half[0] + 1) / 2 * texture.shape[1] - 0.5
        row = (1 - y / face.half[1]) / 2 * texture.shape[0] - 0.5
        grey[hit] = _bilinear(texture, column, row)
        nearest[hit] = t[on]
        hit_face[hit] = number
    shape = (bottom - top, RAYS, right - left, RAYS)
    middle = hit_face.reshape(shape)[:, RAYS // 2, :, RAYS // 2]
    return grey.reshape(shape).mean(axis=(1, 3)), middle


@lru_cache(maxsize=8)
def _texture(scene: Scene, number: int) -> np.ndarray:
    return face_texture(scene, number, scene.faces()[number])


def _bilinear(texture: np.ndarray, column: np.ndarray, row: np.ndarray) -> np.ndarray:
    texture = cv2.copyMakeBorder(texture, 1, 1, 1, 1, cv2.BORDER_REPLICATE)
    column = np.clip(column + 1, 0, texture.shape[1] - 1.001)
    row = np.clip(row + 1, 0, texture.shape[0] - 1.001)
    c, r = column.astype(int), row.astype(int)
    a, b = column - c, row - r
    return ((1 - b) * ((1 - a) * texture[r, c] + a * texture[r, c + 1])
            + b * ((1 - a) * texture[r + 1, c] + a * texture[r + 1, c + 1]))
