"""Images of a scene from a camera on a moving vehicle."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from perch_core import so3
from perch_core.camera import Region
from perch_core.camera_mount import CameraMount
from perch_sim.rendering.atlas import build_atlas
from perch_sim.rendering.cables import CablePainter
from perch_sim.rendering.grid import build_grid
from perch_sim.rendering.raster import Rasterizer
from perch_sim.rendering.scene import Scene
from perch_sim.rendering.sensor import Sensor, control_exposure
from perch_sim.rendering.visibility import FaceArrays, face_matrices

BLUR_STEP = 2.0  # motion across the image that one sub-frame may stand for [px]
MAX_SUBFRAMES = 6

# Textures are grey; in colour dark ones are a little warm and bright ones a little cold, none of them red.
TINT = np.stack([np.arange(256) * share for share in
                 (np.linspace(1.02, 0.95, 256), np.ones(256), np.linspace(0.93, 0.98, 256))], axis=-1)

Pose = tuple[np.ndarray, np.ndarray]  # p_WB (3,) [m], R_WB (3, 3)


class Renderer:
    """Renders camera images of a scene.

    An instance has no mutable state, so that several threads may call `render` at once; OpenCV releases the
    interpreter lock in the costly parts. The same poses and the same state of `rng` give the same bytes.

    Attributes:
        exposure: exposure that the exposure control sets for the scene's light; the poses of a frame are to be
            spread over `exposure.time` [s].
    """

    def __init__(self, scene: Scene, mount: CameraMount, seed: int = 0) -> None:
        """Draw the textures and lay out the image.

        Args:
            scene: scene to render; renderers of the same `Scene` object share its textures.
            mount: the camera and its pose on the body; `mount.colour` selects rgb8.
            seed: seed of the sensor's noise bank.
        """
        self.scene, self.mount = scene, mount
        self.exposure = control_exposure(mount, scene.light)
        self._faces = FaceArrays.of(scene.faces())
        self._whole = (slice(0, mount.camera.height), slice(0, mount.camera.width))
        self._grid = build_grid(mount.camera)
        self._raster = Rasterizer(self._faces, build_atlas(scene), mount.camera, self._grid)
        self._cables = CablePainter(scene.cables, mount.camera) if scene.cables else None
        self._tint = np.rint(TINT).astype(np.uint8)[None]
        self._sensor = Sensor(mount.camera, self.exposure, 3 if mount.colour else 1, seed)

    def render(self, poses: Sequence[Pose], rng: np.random.Generator, target_shift: np.ndarray = np.zeros(3),
               region: Region | None = None) -> np.ndarray:
        """Return the image of one exposure.

        Args:
            poses: (p_WB [m], R_WB) of the body, evenly spread over the exposure, one or more.
            rng: random generator of this frame's noise.
            target_shift: displacement of the target panel and its pad from their positions in the scene [m], shape (3,), or (n, 3):
                one for each pose.
            region: rows and columns to render; the rest of the image is black. None: all of it.

        Returns:
            mono8, uint8 (height, width); with `mount.colour` rgb8, uint8 (height, width, 3).
        """
        shifts_W = np.broadcast_to(np.asarray(target_shift, dtype=float), (len(poses), 3))
        poses = [(np.asarray(p, dtype=float), np.asarray(R, dtype=float)) for p, R in poses]
        region = region or self._whole
        blurred = self._sensor.blur_region(region)
        count = self._subframes(poses, shifts_W)
        frames = [self._light(*self.mount.pose(p, R), shift_W, blurred)
                  for (p, R), shift_W in zip(spread(poses, count), spread_shifts(shifts_W, count))]
        light = frames[0]
        if len(frames) > 1:
            mean = sum(frame[blurred].astype(np.uint16) for frame in frames)
            light[blurred] = (mean + len(frames) // 2) // len(frames)
        return self._sensor.expose(light, rng, region)

    def _light(self, p_WC: np.ndarray, R_WC: np.ndarray, shift_W: np.ndarray, region: Region | None = None) -> np.ndarray:
        """Render a region at one instant, before the optics and under the light for which the exposure is set, uint8."""
        image = self._raster.draw(p_WC, R_WC, shift_W, region or self._whole)
        if self.mount.colour:
            image = cv2.LUT(cv2.merge([image] * 3), self._tint)
        if self._cables is not None:
            M, _, front = face_matrices(self._faces, p_WC, R_WC, shift_W)
            self._cables.paint(image, p_WC, R_WC, M[front], self._faces.half[front])
        return image

    def _subframes(self, poses: list[Pose], shifts_W: np.ndarray) -> int:
        """Return the number of sub-frames that the motion across the image during the exposure requires."""
        if len(poses) < 2:
            return 1
        (p0, R0), (p1, R1) = (self.mount.pose(*pose) for pose in (poses[0], poses[-1]))
        moving, path_W = self._faces.moving, p1 - p0
        centre_W = self._faces.centre_W + moving[:, None] * shifts_W[0]
        depth = np.maximum(np.abs((centre_W - p0) * self._faces.normal_W).sum(axis=1), 0.05)
        travel = np.where(moving, np.linalg.norm(path_W - (shifts_W[-1] - shifts_W[0])), np.linalg.norm(path_W))  # relative to each face
        turn = 2.0 * np.arcsin(min(np.linalg.norm(R1 - R0) / np.sqrt(8.0), 1.0))
        speed = np.sort(travel / depth)[-2]  # of the face with the second fastest image
        if self._cables is not None:
            speed = max(speed, np.linalg.norm(path_W) / max(self._cables.distance(p0), 0.05))
        motion = self.mount.camera.fx * (turn + speed)
        return int(np.clip(np.ceil(motion / BLUR_STEP), 1, MAX_SUBFRAMES))


def spread(poses: list[Pose], count: int) -> list[Pose]:
    """Return `count` poses at the middles of equal shares of the time that `poses` span evenly."""
    if len(poses) == 1:
        return poses * count
    out = []
    for share in (np.arange(count) + 0.5) / count * (len(poses) - 1):
        before = min(int(share), len(poses) - 2)
        part = share - before
        (p0, R0), (p1, R1) = poses[before], poses[before + 1]
        out.append((p0, R0) if part == 0.0 else (p0 + part * (p1 - p0), R0 @ so3.exp(part * so3.log(R0.T @ R1))))
    return out


def spread_shifts(shifts_W: np.ndarray, count: int) -> np.ndarray:
    """Return the displacements (count, 3) at the times of `spread`, from those of the poses (n, 3)."""
    share = (np.arange(count) + 0.5) / count * (len(shifts_W) - 1)
    return np.stack([np.interp(share, np.arange(len(shifts_W)), column) for column in shifts_W.T], axis=1)
