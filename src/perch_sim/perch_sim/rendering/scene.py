"""Scene in front of the cameras: a room, the inclined panel with its pad, cables.

A `Scene` is a frozen description; `Scene.faces()` decomposes it into the flat rectangles that are rendered.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from perch_core.errors import ConfigError
from perch_core.surface import PerchSurface
from perch_core.tag_board import TagBoard

PAD_THICKNESS = 2e-3  # the pad lies in the perching plane, the panel that carries it just behind [m]
FLOOR_TEXEL, WALL_TEXEL, PANEL_TEXEL = 2.5e-3, 4e-3, 2.5e-3  # the floor is seen from the closest [m]
ROOM_TEXELS = 25e6  # a large room gets coarser textures, so that memory and start stay small
PLATE_TEXELS = 8e6  # ... and so do a large panel and a large pad
SIDE_TEXELS = 16_000  # along the longer side of a face
PAD_TEXELS_PER_MODULE = 32  # of a tag's 8 x 8 modules: every printed edge falls on a texel's border


@dataclass(frozen=True, eq=False)
class CableCurve:
    """A cable as a polyline in W.

    Attributes:
        points_W: shape (n, 3) [m], dense enough for straight pieces between them.
        radius: [m].
        colour: red, green, blue in [0, 255] under full light.
    """

    points_W: np.ndarray
    radius: float
    colour: tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Face:
    """A flat textured rectangle, visible only from the side to which its normal points.

    Attributes:
        centre_W: [m], shape (3,).
        right_W, up_W: unit axes of the texture, shape (3,); the normal is right x up.
        half: half extents along right and up [m].
        kind: `room`, `panel` or `pad`.
        texel: size of a texel [m].
        bounded: whether the rectangle ends at its edges; faces of the room are bounded by each other.
        moving: whether it moves with the target.
    """

    centre_W: np.ndarray
    right_W: np.ndarray
    up_W: np.ndarray
    half: tuple[float, float]
    kind: str
    texel: float
    bounded: bool = True
    moving: bool = False

    @property
    def normal_W(self) -> np.ndarray:
        """Unit normal towards the viewer, shape (3,)."""
        return np.cross(self.right_W, self.up_W)


@dataclass(frozen=True, eq=False)
class Scene:
    """Description of everything visible.

    Attributes:
        room_low, room_high: opposite corners of the room in W [m], shape (3,).
        target: the panel that carries the pad (its `size` is the panel's), or None.
        board: the tags on the pad, in the middle of the target panel.
        cables: cables.
        contrast: Michelson contrast of the textures: 99 % of the texels lie within mean (1 +- contrast).
        light: brightness of the light; the cameras' default exposure is set for 1.
        seed: seed of the textures.
    """

    room_low: np.ndarray
    room_high: np.ndarray
    target: PerchSurface | None = None
    board: TagBoard | None = None
    cables: tuple[CableCurve, ...] = ()
    contrast: float = 0.25
    light: float = 1.0
    seed: int = 0

    def __post_init__(self) -> None:
        object.__setattr__(self, "room_low", np.array(self.room_low, dtype=float).reshape(3))
        object.__setattr__(self, "room_high", np.array(self.room_high, dtype=float).reshape(3))
        if not np.all(self.room_high - self.room_low > 0.1):
            raise ConfigError("Scene", "room_high", f"{self.room_high.tolist()} is not above {self.room_low.tolist()}")
        if not 0.0 <= self.contrast <= 1.0:
            raise ConfigError("Scene", "contrast", f"{self.contrast!r} is outside [0, 1]")
        if not self.light > 0.0:
            raise ConfigError("Scene", "light", f"{self.light!r} is not > 0")
        if self.board is not None and self.target is None:
            raise ConfigError("Scene", "board", "a board needs a target panel that carries it")

    def faces(self) -> tuple[Face, ...]:
        """Return all rectangles, the six of the room first."""
        faces = list(_room_faces(self.room_low, self.room_high))
        if self.target is not None:
            faces += _panel_faces(self.target, depth=PAD_THICKNESS if self.board else 0.0)
        if self.board is not None and self.target is not None:
            pad = PerchSurface(self.target.p_WS, self.target.R_WS, self.board.pad_size)
            texel = self.board.tags[0].size / self.board.modules / PAD_TEXELS_PER_MODULE
            faces.append(_surface_face(pad, "pad", texel))
        return tuple(_within_atlas(face) for face in faces)


def _within_atlas(face: Face) -> Face:
    """Return a face, with coarser texels where its texture would be too large for the atlas."""
    half_u, half_v = face.half
    texels = ROOM_TEXELS if face.kind == "room" else PLATE_TEXELS
    return replace(face, texel=max(face.texel, 2 * max(half_u, half_v) / SIDE_TEXELS, math.sqrt(4 * half_u * half_v / texels)))


def _surface_face(surface: PerchSurface, kind: str, texel: float) -> Face:
    s1, s2 = surface.R_WS[:, 0], surface.R_WS[:, 1]
    return Face(surface.p_WS, -s2, s1, (surface.size[1] / 2, surface.size[0] / 2), kind, texel, moving=True)


def _panel_faces(panel: PerchSurface, depth: float) -> list[Face]:
    """Return front and back of a thin panel whose front lies `depth` behind the surface's plane."""
    centre = panel.p_WS - depth * panel.normal
    front = _surface_face(PerchSurface(centre, panel.R_WS, panel.size), "panel", PANEL_TEXEL)
    back = Face(centre, -front.right_W, front.up_W, front.half, "panel", WALL_TEXEL, moving=True)
    return [front, back]


def _room_faces(low: np.ndarray, high: np.ndarray) -> list[Face]:
    """Return floor, ceiling and four walls, with inward normals."""
    centre, half = (low + high) / 2, (high - low) / 2
    length, width, height = high - low
    walls = length * width + 2 * (length + width) * height
    coarser = math.sqrt(max(1.0, (length * width / FLOOR_TEXEL**2 + walls / WALL_TEXEL**2) / ROOM_TEXELS))
    x, y, z = np.eye(3)
    layout = ((x, y, 2, -1), (x, -y, 2, +1), (-y, z, 0, +1), (y, z, 0, -1), (x, z, 1, +1), (-x, z, 1, -1))
    faces = []
    for right, up, axis, side in layout:
        where = centre.copy()
        where[axis] += side * half[axis]
        texel = coarser * (FLOOR_TEXEL if axis == 2 and side < 0 else WALL_TEXEL)
        faces.append(Face(where, right, up, (abs(right) @ half, abs(up) @ half), "room", texel, bounded=False))
    return faces
