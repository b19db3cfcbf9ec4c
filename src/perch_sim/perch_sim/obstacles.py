"""Obstacles for the vehicle: floor, walls, ceiling and the panel with the pad, as rectangles with an outward normal."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from perch_core.errors import ConfigError
from perch_core.surface import PerchSurface
from perch_core.tag_board import load_board
from perch_sim.scenario import Scenario

FAR = 1e9          # extent of a plane without an end [m]
PANEL_DEPTH = 0.1  # the panel is this thick [m]


class Surfaces(NamedTuple):
    """Rectangles, one per row. Columns of `axes` are s1, s2 and the outward normal s3; they translate with `velocity`."""

    origin: np.ndarray     # p_WS at time zero, (m, 3) [m]
    axes: np.ndarray       # R_WS, (m, 3, 3)
    half_size: np.ndarray  # along s1 and s2, (m, 2) [m]
    depth: np.ndarray      # how deep a point can be inside, (m,) [m]
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
        names.append("pad")
        origin.append(surface.p_WS)
        axes.append(surface.R_WS)
        half.append(np.array(scenario.target.panel_size) / 2)
        depth.append(PANEL_DEPTH)
        velocity.append(np.array(scenario.target.velocity, float))
    return Obstacles(
        Surfaces(np.array(origin), np.ascontiguousarray(np.array(axes)), np.array(half), np.array(depth), np.array(velocity)),
        tuple(names), pad, pad_half)
