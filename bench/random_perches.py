"""Random perching problems."""

from __future__ import annotations

import numpy as np

from perch_core import config
from perch_core.surface import PerchSurface
from perch_eval.node_launch import read_parameters
from perch_planner.problem import PerchProblem, PerchSettings, StartState, Waypoint


def shipped_settings() -> PerchSettings:
    """The planner's settings in `config/perching_planner.yaml`."""
    return config.from_mapping(PerchSettings, read_parameters("perching_planner"), "perching_planner.yaml")


def random_problem(rng: np.random.Generator) -> PerchProblem:
    """Draw a problem: any inclination and heading, 1-5 m away, start in motion, 0-10 waypoints or, at times, a moving pad.

    Args:
        rng: source of randomness.
    """
    count = int(rng.integers(0, 11))
    heading, inclination = rng.uniform(-np.pi, np.pi), rng.uniform(0.0, np.pi)
    distance = rng.uniform(1.0, 5.0)
    p_WS = np.array([0.0, 0.0, rng.uniform(1.5, 3.0)])
    surface = PerchSurface.from_inclination(p_WS, inclination, heading)
    # In front of the surface, within 60 degrees of a mix of its normal and the way back along the heading.
    back = np.array([-np.cos(heading), -np.sin(heading), 0.0])
    direction = surface.normal + 0.7 * back + 0.35 * rng.normal(size=3)
    p0 = p_WS + distance * direction / np.linalg.norm(direction)
    p0[2] = max(p0[2], 0.6)
    motion = {"v": rng.normal(0.0, 0.5, 3), "a": rng.normal(0.0, 0.7, 3), "j": rng.normal(0.0, 2.0, 3), "yaw_rate": rng.normal(0.0, 0.2)}
    start = StartState(p0, yaw=heading + rng.uniform(-1.0, 1.0), **motion)
    share = np.linspace(0.0, 1.0, count + 2)[1:-1]
    points = [p0 + s * (p_WS + 0.2 * surface.normal - p0) + rng.normal(0.0, 0.04 * distance / (1 + 0.3 * count), 3) for s in share]
    velocity = rng.normal(0.0, 0.6, 3) * (1.0, 1.0, 0.2) if rng.random() < 0.25 and not count else np.zeros(3)
    return PerchProblem(start, surface, tuple(Waypoint(p) for p in points), velocity)


def paper_like_problem(rng: np.random.Generator, waypoints: int) -> PerchProblem:
    """A problem as in M-V: from hover, 40-90 degrees, 1.7-3 m, waypoints scattered about the straight way.

    Args:
        rng: source of randomness.
        waypoints: their number.
    """
    heading, inclination = rng.uniform(-np.pi, np.pi), np.radians(rng.uniform(40.0, 90.0))
    ahead = np.array([np.cos(heading), np.sin(heading), 0.0])
    p0 = np.array([0.0, 0.0, 1.5])
    p_WS = p0 + rng.uniform(1.7, 3.0) * ahead + (0.0, 0.0, rng.uniform(-0.3, 0.3))
    surface = PerchSurface.from_inclination(p_WS, inclination, heading)
    before = p_WS + 0.5 * surface.normal
    share = np.linspace(0.0, 1.0, waypoints + 2)[1:-1]
    points = [p0 + s * (before - p0) + rng.normal(0.0, 0.36 / max(waypoints, 1), 3) for s in share]
    return PerchProblem(StartState(p0, yaw=heading), surface, tuple(Waypoint(p) for p in points))
