"""Random layouts for inspection: three cables, and waypoints whose lines collide twice and keep the cable off-centre. [P:VI-A]"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from perch_core.arrays import Vector3
from perch_core.lines import Segment, scaled_clearance, segment_distance
from perch_core.vehicle import load_vehicle
from perch_eval.inspection.measures import clearance, collisions, reference_states, segments
from perch_sim.scenario import Cable, Scenario, Start, Waypoint

RADIUS = 0.03           # of the cables [m]
WAYPOINTS = 6
OFF_CENTRE = (0.2, 0.6)  # height of the cable over the image centre at a waypoint, by its distance: 80 to 230 px of the rpg's camera
APART = 0.15            # least distance between two cables [m]
CLEAR = 0.3             # least scaled clearance at the first and at the last waypoint, and on the way up
DRAWS = 1000


def random_layout(base: Scenario, seed: int) -> Scenario:
    """Return `base` with random cables and waypoints, such that the reference collides exactly twice.

    The watched cable hangs about 4 m in front, with an azimuth of up to 12 deg and an inclination of up to 6 deg. The waypoints
    run along it at 1.4 to 2.4 m; their heights put the cable 80 to 230 px from the image centre, their yaw is up to 25 deg off.
    One or two slanted cables cross the reference; if only one does, the reference also touches the watched cable.

    Args:
        base: scenario with everything that is not drawn.
        seed: seed of the layout.

    Raises:
        RuntimeError: no such layout was found.
    """
    rng = np.random.default_rng(seed)
    vehicle = load_vehicle(base.vehicle)
    for _ in range(DRAWS):
        scenario = _draw(base, rng)
        cables = segments(scenario)
        clear = clearance(reference_states(scenario)[1], cables, vehicle.body_radii)
        apart = min(segment_distance(a, b) for k, a in enumerate(cables) for b in cables[:k])
        if apart > APART and min(clear[0], clear[-1]) > CLEAR and _way_up(scenario, cables, vehicle.body_radii) and collisions(clear) == 2:
            return dataclasses.replace(scenario, name=f"{base.name}_{seed}")
    raise RuntimeError(f"no layout within {DRAWS} draws of seed {seed}")


def _draw(base: Scenario, rng: np.random.Generator) -> Scenario:
    azimuth, elevation = np.radians(rng.uniform(-12, 12)), np.radians(rng.uniform(-6, 6))
    along = np.array([-math.sin(azimuth) * math.cos(elevation), math.cos(azimuth) * math.cos(elevation), math.sin(elevation)])
    away = np.array([math.cos(azimuth), math.sin(azimuth), 0.0])  # from the vehicle to the cable
    up = np.array([0.0, 0.0, 1.0])
    centre = np.array([4.0, 0.0, rng.uniform(2.4, 3.2)])
    places = np.linspace(-2.5, 2.5, WAYPOINTS) + rng.uniform(-0.2, 0.2, WAYPOINTS)
    distances = rng.uniform(1.6, 2.2) + rng.uniform(-0.2, 0.2, WAYPOINTS)
    heights = distances * rng.uniform(*OFF_CENTRE, WAYPOINTS) * rng.choice([-1.0, 1.0], WAYPOINTS)
    touching = rng.random() < 0.5
    legs = sorted(rng.choice(np.arange(1, WAYPOINTS - 1), 2, replace=False).tolist())
    if touching:
        k = legs[1]
        distances[k], heights[k] = rng.uniform(0.0, 0.2), rng.uniform(-0.1, 0.1)
    points = centre + np.outer(places, along) - np.outer(distances, away) + np.outer(heights, up)
    yaws = np.degrees(azimuth) + rng.uniform(-25, 25, WAYPOINTS)
    cables = [(centre - 4.0 * along, centre + 4.0 * along)]
    for leg in legs[:1] if touching else legs:
        crossing = points[leg] + rng.uniform(0.3, 0.7) * (points[leg + 1] - points[leg])
        slant = np.radians(rng.uniform(-60, 60))
        direction = math.cos(slant) * away + math.sin(slant) * up + rng.uniform(-0.3, 0.3) * along
        direction /= np.linalg.norm(direction)
        middle, half = crossing + rng.uniform(-0.5, 0.5) * direction, rng.uniform(0.8, 1.5)
        cables.append((middle - half * direction, middle + half * direction))
    if touching:
        behind = centre + rng.uniform(0.8, 1.2) * away + rng.uniform(-0.6, 0.6) * up
        cables.append((behind - 4.0 * along, behind + 4.0 * along))
    inspection = dataclasses.replace(
        base.inspection, watched=_vector(centre),
        waypoints=tuple(Waypoint(position=_vector(p), yaw_deg=float(yaw)) for p, yaw in zip(points, yaws)))
    world = dataclasses.replace(base.world, cables=tuple(Cable(start=_vector(a), end=_vector(b), radius=RADIUS) for a, b in cables))
    start = Start(position=(float(points[0, 0]), float(points[0, 1]), 0.0), yaw_deg=float(yaws[0]))
    return dataclasses.replace(base, inspection=inspection, world=world, start=start)


def _way_up(scenario: Scenario, cables: list[Segment], radii: Vector3) -> bool:
    """Return whether the take-off, straight up to the first waypoint, is clear of the cables."""
    x, y, z = scenario.inspection.waypoints[0].position
    column = np.column_stack([np.full(30, x), np.full(30, y), np.linspace(0.0, z, 30)])
    level = np.tile([0.0, 0.0, 0.0, 1.0], (30, 1))
    return all(float(scaled_clearance(column, level, c, radii).min()) > CLEAR for c in cables)


def _vector(v: np.ndarray) -> tuple[float, float, float]:
    return (float(v[0]), float(v[1]), float(v[2]))
