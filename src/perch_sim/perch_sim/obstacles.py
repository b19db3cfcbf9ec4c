"""Obstacles for the vehicle: floor, walls, ceiling and the panel with the pad, as rectangles with an outward normal.

The panel is a box of six rectangles; a point inside is pushed out through the nearest one.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from perch_core.errors import ConfigError
from perch_core.surface import PerchSurface
from perch_core.tag_board import load_board
from perch_sim.scenario import Scenario

FAR = 1e9          # extent of a plane without an end [m]
PANEL_DEPTH = 0.2  # the panel is this thick [m]


class Surfaces(NamedTuple):
    """Rectangles, one per row. Columns of `axes` are s1, s2 and the outward normal s3; they translate with `velocity`."""

    origin: np.ndarray     # p_WS at time zero, (m, 3) [m]
    axes: np.ndarray       # R_WS, (m, 3, 3)
    half_size: np.ndarray  # along s1 and s2, (m, 2) [m]
    depth: np.ndarray      # points deeper than this are not inside, (m,) [m]
    velocity: np.ndarray   # (m, 3) [m/s]


class Obstacles(NamedTuple):
    """The surfaces with their names, and the pad on one of them."""

    surfaces: Surfaces
    names: tuple[str, ...]
    pad: int | None          # row of the panel that carries the pad
    pad_half: np.ndarray     # half extent of the pad along s1 and s2, (2,) [m]


def _axes(normal: np.ndarray) -> np.ndarray:
    """Return a rotation whose third column is `normal`, (3, 3)."""
    helper = np.eye(3)[int(np.argmin(np.abs(normal)))]
    s1 = np.cross(helper, normal)
    s1 /= np.linalg.norm(s1)
    return np.stack([s1, np.cross(normal, s1), normal], axis=1)


def _box(front: PerchSurface, size: tuple[float, float]) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Return origin [m], axes and half size [m] of the panel's faces: front, back, and those along its edges."""
    (s1, s2, s3), half = front.R_WS.T, np.array([*size, PANEL_DEPTH]) / 2
    centre = front.p_WS - half[2] * s3
    faces = [(front.p_WS, front.R_WS, half[:2]), (centre - half[2] * s3, np.stack([s2, s1, -s3], axis=1), half[[1, 0]])]
    for side in (1.0, -1.0):
        faces.append((centre + side * half[0] * s1, np.stack([s2, side * s3, side * s1], axis=1), half[[1, 2]]))
        faces.append((centre + side * half[1] * s2, np.stack([s3, side * s1, side * s2], axis=1), half[[2, 0]]))
    return faces


def pad_surface(scenario: Scenario, time: float) -> PerchSurface:
    """Return the true pad at a time [s] since the start of the flight."""
    surface = scenario.surface
    return PerchSurface(surface.p_WS + np.array(scenario.target.velocity) * time, surface.R_WS, surface.size)


def make_obstacles(scenario: Scenario) -> Obstacles:
    """Return floor, ceiling and walls of the room, and in surface scenarios the panel with its pad.

    Raises:
        ConfigError: the board does not exist, or its pad is larger than the panel.
    """
    length, width, height = scenario.world.room
    cx, cy = scenario.world.room_centre
    planes = [("floor", (cx, cy, 0.0), (0, 0, 1)), ("ceiling", (cx, cy, height), (0, 0, -1)),
              ("wall", (cx + length / 2, cy, 0.0), (-1, 0, 0)), ("wall", (cx - length / 2, cy, 0.0), (1, 0, 0)),
              ("wall", (cx, cy + width / 2, 0.0), (0, -1, 0)), ("wall", (cx, cy - width / 2, 0.0), (0, 1, 0))]
    names = [name for name, _, _ in planes]
    origin = [np.array(point, float) for _, point, _ in planes]
    axes = [_axes(np.array(normal, float)) for _, _, normal in planes]
    half = [np.array([FAR, FAR]) for _ in planes]
    depth, velocity = [FAR] * len(planes), [np.zeros(3) for _ in planes]
    pad, pad_half = None, np.zeros(2)
    if scenario.mode == "surface":
        surface = scenario.surface
        pad, pad_half = len(names), np.array(load_board(scenario.target.board).pad_size) / 2
        if np.any(np.array(scenario.target.panel_size) / 2 < pad_half):
            raise ConfigError("", "target.panel_size", f"{list(scenario.target.panel_size)} m is below the pad's {(2 * pad_half).tolist()} m")
        panel = _box(surface, scenario.target.panel_size)
        names += ["pad", *["panel"] * 5]
        for point, R, size in panel:
            origin.append(point)
            axes.append(R)
            half.append(size)
        depth += [PANEL_DEPTH / 2] * len(panel)
        velocity += [np.array(scenario.target.velocity, float)] * len(panel)
    return Obstacles(
        Surfaces(np.array(origin), np.ascontiguousarray(np.array(axes)), np.array(half), np.array(depth), np.array(velocity)),
        tuple(names), pad, pad_half)
