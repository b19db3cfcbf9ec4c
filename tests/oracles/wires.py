"""Wires for tests of the mapper: sightings without an image, and scenes to render."""

from __future__ import annotations

import numpy as np

from perch_core.catenary import Catenary
from perch_core.vehicle import load_vehicle
from perch_perception.line_mapping import LineObservation, WireCurve
from perch_sim.rendering import CableCurve, Scene

MOUNT = load_vehicle("rpg").mounts["front"]
RED = (190.0, 35.0, 35.0)
WIRE = WireCurve(np.array([3.0, 0.4, 2.5]), np.array([0.1, 0.98, 0.17]) / np.linalg.norm([0.1, 0.98, 0.17]), 0.02)


def observe(rng, curve, centre, noise=0.0, span=(-2.0, 2.0), time=0.0, sigma=5e-4, radius=0.0, believed=None):
    """A sighting of a curve from a camera's true centre, placed where that is believed to be.

    Its rays share an error of `noise` [rad] across the wire; of a wire with a radius [m] the width is measured, too.
    """
    rays = curve.at(np.linspace(*span, 7)) - centre
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    across = np.cross(rays, curve.tangent(0.0))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    rays = rays + noise * rng.standard_normal((7, 1)) * across
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    to = curve.point - centre
    distance = np.linalg.norm(to - (to @ curve.direction) * curve.direction)
    return LineObservation(time, centre if believed is None else believed, rays, rays[[0, -1]], sigma, 2.0 * np.arcsin(radius / distance))


def cables(sag, radius=0.012, colour=RED):
    hanging = [Catenary.from_sag(np.array(a), np.array(b), sag) for a, b in (
        ([3.0, -4.0, 2.6], [3.0, 4.0, 2.8]), ([3.6, -4.0, 2.1], [3.2, 4.0, 2.0]), ([3.3, -4.0, 3.3], [3.9, 4.0, 3.1]))]
    scene = Scene(np.array([-3.0, -4.5, 0.0]), np.array([9.0, 4.5, 6.0]), contrast=0.25, seed=1,
                  cables=tuple(CableCurve(cable.sample(60), radius, colour) for cable in hanging))
    return hanging, scene
