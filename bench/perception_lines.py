"""Speed and accuracy of the powerline mapper on rendered images; part of `python3 scripts/bench.py perception`."""

from __future__ import annotations

import time

import cv2
import numpy as np
from harness import Figure, figure
from perch_core import so3
from perch_core.catenary import Catenary
from perch_core.vehicle import load_vehicle
from perch_perception.line_mapping import LineDetectionConfig, LineMapper, detect_lines, place
from perch_perception.pose_buffer import BodyState
from perch_sim.rendering import CableCurve, Renderer, Scene

CABLES = (([3.0, -4.0, 2.6], [3.0, 4.0, 2.8]), ([3.6, -4.0, 2.1], [3.2, 4.0, 2.0]), ([3.3, -4.0, 3.3], [3.9, 4.0, 3.1]))
REACH = 1.5  # of the bar: around the point in front of the vehicle [m]
NOT_MAPPED = 25.0  # mean error of a wire from which on the nearest line is another wire's, 0.7 m away [cm]


def figures(quick: bool) -> list[Figure]:
    """Measure mapping in 0.8 m of motion in front of three sagging wires, with typical errors of the estimator."""
    cv2.setNumThreads(1)
    mount = load_vehicle("rpg").mounts["front"]
    cables = [Catenary.from_sag(np.array(a), np.array(b), 0.1) for a, b in CABLES]
    scene = Scene(np.array([-3.0, -4.5, 0.0]), np.array([9.0, 4.5, 6.0]), contrast=0.25, seed=1,
                  cables=tuple(CableCurve(c.sample(60), 0.012, (190.0, 35.0, 35.0)) for c in cables))
    renderer = Renderer(scene, mount, seed=1)
    errors, detection, mapping = [], [], []
    for seed in range(3 if quick else 20):
        lines = _fly(renderer, np.random.default_rng(seed), detection, mapping)
        for cable in cables:
            points = cable.sample(300)
            points = points[np.abs(points[:, 1]) < REACH]
            errors.append(100 * np.mean(np.min([line.segment.distance(points) for line in lines], axis=0)) if lines else np.inf)
    return [figure("lines: detection", "ms", detection), figure("lines: map update", "ms", mapping),
            figure("lines: mean error within 1.5 m, after 0.8 m of motion", "cm", [np.mean(errors)], 3.0),
            figure("lines: error of each wire", "cm", errors),
            figure("lines: not mapped", "wires", [sum(error > NOT_MAPPED for error in errors)], 0.0, "max ==")]


def _fly(renderer, rng, detection, mapping):
    """Return the mapped lines after 16 images at 10 Hz."""
    mapper, result = LineMapper(), None
    drift, turn = rng.normal(0, 0.005, 3), so3.exp(np.radians(0.2) * rng.standard_normal(3))
    for k, share in enumerate(np.linspace(0.0, 1.0, 16)):
        p_WB = np.array([0.0, 0.0, 1.8 + 0.8 * share])
        R_WB = so3.exp(np.array([0.04 * np.sin(5 * share), -0.2 + 0.05 * np.sin(7 * share), 0.03 * np.sin(9 * share)]))
        image = renderer.render([(p_WB, R_WB)], rng)
        noise = so3.exp(np.radians(0.03) * rng.standard_normal(3))
        body = BodyState(0.1 * k, p_WB + drift + rng.normal(0, 0.001, 3), so3.quat_from_matrix(noise @ turn @ R_WB),
                         np.zeros(3), np.zeros(3), np.diag([2.5e-5] * 3 + [1.2e-5] * 3))
        begin = time.perf_counter()
        sightings = detect_lines(image, renderer.mount.camera, LineDetectionConfig())
        detection.append(1e3 * (time.perf_counter() - begin))
        begin = time.perf_counter()
        result = mapper.update(body.time, body, [place(one, body, renderer.mount) for one in sightings])
        mapping.append(1e3 * (time.perf_counter() - begin))
    return result.lines
