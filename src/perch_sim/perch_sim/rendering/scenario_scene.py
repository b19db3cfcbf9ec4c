"""Construction of the scene that a scenario describes."""

from __future__ import annotations

import numpy as np

from perch_core.surface import PerchSurface
from perch_core.tag_board import load_board
from perch_sim.rendering.scene import CableCurve, Scene
from perch_sim.scenario import Cable, Scenario

CABLE_COLOURS = {"red": (190.0, 35.0, 35.0), "grey": (88.0, 88.0, 92.0)}  # rgb under full light
CABLE_SPACING = 0.25  # between the points of a cable's polyline, at most [m]
CABLE_ERROR = 1e-3  # of the polyline [m]


def build_scene(scenario: Scenario, seed: int = 0) -> Scene:
    """Return the scene of a scenario: room, target panel with its pad, cables and light.

    Args:
        scenario: flight whose scene is built.
        seed: seed of the textures.

    Raises:
        ConfigError: the scenario's board does not exist.
    """
    world = scenario.world
    half = np.array(world.room) / 2
    centre = np.array([*world.room_centre, half[2]])
    target = board = None
    if scenario.mode == "surface":
        surface = scenario.surface
        target = PerchSurface(surface.p_WS, surface.R_WS, scenario.target.panel_size)
        board = load_board(scenario.target.board)
    return Scene(room_low=centre - half, room_high=centre + half, target=target, board=board,
                 cables=tuple(_curve(cable) for cable in world.cables),
                 contrast=world.contrast, light=world.light, seed=seed)


def _curve(cable: Cable) -> CableCurve:
    catenary = cable.catenary()
    count = 1 + max(int(np.ceil(catenary.length / CABLE_SPACING)), catenary.pieces(CABLE_ERROR))
    return CableCurve(catenary.sample(count), cable.radius, CABLE_COLOURS[cable.colour])
