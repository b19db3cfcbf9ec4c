"""Checks, before any node is started, that the nodes accept a scenario and that a flight of it can succeed."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from perch_control.mission.missions import mission_class, mode_of
from perch_core import config
from perch_core.errors import ConfigError
from perch_core.tag_board import load_board
from perch_core.vehicle import Vehicle, load_vehicle
from perch_sim.scenario import Scenario

MAX_VIEW_ANGLE = 80.0
"""Largest angle between line of sight and pad normal [deg]; beyond it, a 0.16 m tag at 1.7 m is 4 px wide."""


def check_names(scenario: Scenario, source: str | Path) -> Vehicle:
    """Check that everything the scenario names exists, and return its vehicle.

    Args:
        scenario: to be checked.
        source: its file, for messages.

    Raises:
        ConfigError: no such vehicle, tag board or mission, or one of the files is refused.
    """
    for key, kind, name in (("vehicle", "vehicles", scenario.vehicle), ("target.board", "boards", scenario.target.board)):
        try:
            config.find(kind, name)
        except ConfigError as error:
            raise ConfigError(str(source), key, f"{name!r}: {error.problem}") from None
    try:
        mission_class(mode_of(scenario.mission_type))
    except ConfigError as error:
        raise ConfigError(str(source), error.key, error.problem) from None
    load_board(scenario.target.board)
    return load_vehicle(scenario.vehicle)


def check_flight(scenario: Scenario, source: str | Path, vehicle: Vehicle | None = None) -> None:
    """Check that a flight of the scenario can begin and that its pad is visible from the search hover.

    Args:
        scenario, source: as in `check_names`.
        vehicle: as returned by `check_names`; None: that is called here.

    Raises:
        ConfigError: the scenario is refused; the message has the value, its key and the allowed range.
    """
    vehicle = vehicle or check_names(scenario, source)
    for node in ("vehicle", "estimator", "controller", "mission"):
        if node not in scenario.nodes:
            raise ConfigError(str(source), "nodes", f"{node!r} is missing; a flight needs it")
    if scenario.mode == "surface":
        _check_view(scenario, str(source), vehicle)


def _check_view(scenario: Scenario, source: str, vehicle: Vehicle) -> None:
    """Check that the pad is in the front camera's image, and seen neither from behind nor too obliquely."""
    mount = vehicle.mounts.get("front")
    if mount is None:
        raise ConfigError(source, "vehicle", f"{scenario.vehicle!r} has no camera 'front', which finds the pad")
    surface, camera = scenario.surface, mount.camera
    hover = np.array(scenario.start.position) + (0.0, 0.0, scenario.mission.takeoff_height)
    sight = surface.p_WS - hover
    elevation = math.degrees(math.atan2(sight[2], math.hypot(sight[0], sight[1])))
    rays = camera.unproject(np.array([[camera.cx, 0.0], [camera.cx, camera.height - 1.0]])) @ mount.R_BC.T
    upper, lower = (math.degrees(math.atan2(ray[2], ray[0])) for ray in rays)
    if not lower <= elevation <= upper:
        raise ConfigError(source, "target.height", f"{scenario.target.height:g} m puts the pad {elevation:.0f} deg above the"
                          f" horizon of the search hover, outside [{lower:.0f}, {upper:.0f}] deg of the front camera's view")
    cosine = float(np.clip(-sight @ surface.normal / np.linalg.norm(sight), -1.0, 1.0))
    obliqueness = math.degrees(math.acos(cosine))
    if obliqueness > MAX_VIEW_ANGLE:
        raise ConfigError(source, "target.inclination_deg",
                          f"{scenario.target.inclination_deg:g} turns the pad {obliqueness:.0f} deg away from the search hover,"
                          f" outside [0, {MAX_VIEW_ANGLE:g}] deg in which its tags can be read")
