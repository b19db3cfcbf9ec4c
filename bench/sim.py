"""Speed of the simulator's renderer: one VGA fisheye frame, one thread."""

from __future__ import annotations

import cv2
import numpy as np

from harness import Figure, figure, measure
from perch_core import so3
from perch_core.vehicle import load_vehicle
from perch_sim.rendering import Renderer, build_scene
from perch_sim.scenario import Cable, Scenario, World, load_scenario

SEEDS = "noise of the images: 0"
WIRES = tuple(Cable(start=(5.0 + 0.5 * i, -4.0, 2.2 + 0.4 * i), end=(5.0 + 0.5 * i, 4.0, 2.3 + 0.4 * i), sag=0.15)
              for i in range(3))


def _pose(x: float, z: float, nose_up: float, turn: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    return np.array([x, 0.02, z]), so3.exp(np.array([0.0, -nose_up, 0.0])) @ so3.exp(np.array([0.0, 0.0, turn]))


# a perch on the wall at 1.7 m, from the ground to just before contact
FLIGHT = [_pose(0.0, 0.1, 0.0), _pose(0.0, 0.6, 0.0), _pose(0.0, 1.2, 0.0), _pose(0.0, 1.2, 0.05), _pose(0.0, 1.2, -0.05),
          _pose(0.3, 1.3, -0.3), _pose(0.7, 1.45, 0.3), _pose(1.1, 1.5, 0.8), _pose(1.4, 1.4, 1.2), _pose(1.6, 1.25, 1.5)]


def figures(quick: bool) -> list[Figure]:
    """Measure a whole flight per camera, frames with motion blur, coloured frames with cables, and the building of a scene."""
    cv2.setNumThreads(1)
    scenario, vehicle = load_scenario("surface_90"), load_vehicle("snapdragon")
    rng = np.random.default_rng(0)
    rounds = 2 if quick else 20
    result = []

    def frames(renderer: Renderer, exposures: list) -> np.ndarray:
        queue = iter(exposures * (rounds + 1))
        return 1e3 * measure(lambda: renderer.render(next(queue), rng), len(exposures) * rounds, len(exposures))

    for name in ("front", "down"):
        renderer = Renderer(build_scene(scenario), vehicle.mounts[name])
        still = frames(renderer, [[pose] for pose in FLIGHT])
        result.append(figure(f"renderer, {name} camera, whole flight", "ms", still, bar=12.0))
    blurred = [[(p, R @ so3.exp(np.array([0.0, -w * 3.5e-3 * k / 4, 0.0]))) for k in range(5)]
               for p, R in FLIGHT[5:9] for w in (7.0, 14.0)]  # 400 and 800 deg/s
    result.append(figure("renderer, down camera, 400-800 deg/s (3-6 sub-frames)", "ms", frames(renderer, blurred)))
    wires = build_scene(Scenario(name="wires", mode="powerline", world=World(room=(16.0, 10.0, 6.0), cables=WIRES)))
    colour = Renderer(wires, load_vehicle("rpg").mounts["front"])
    result.append(figure("renderer, rgb8 front camera, three cables", "ms",
                         frames(colour, [[_pose(x, 2.0, 0.1)] for x in (0.0, 1.0, 2.0, 3.0, 4.0)])))
    build = measure(lambda: Renderer(build_scene(scenario), vehicle.mounts["front"]), 1 if quick else 5, 1)
    result.append(figure("renderer, textures and atlas of a scene", "s", build, bar=2.0))
    return result
