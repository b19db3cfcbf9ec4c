"""How the true cameras differ from what the vehicle's file, and so CameraInfo, says of them."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np

from perch_core import so3
from perch_core.camera_mount import CameraMount
from perch_sim import seeding
from perch_sim.scenario import Scenario

# One sigma of a careful calibration of a unit of this size.
FOCAL_ERROR = 0.003                # of each focal length [-]
CENTRE_ERROR = 0.5                 # of the principal point [px]
ATTITUDE_ERROR = np.radians(0.5)   # of the mounting attitude, all axes together [rad]
TIME_ERROR = 0.002                 # of the stamp offset [s]


def true_mounts(scenario: Scenario, mounts: Mapping[str, CameraMount], seed: int) -> dict[str, CameraMount]:
    """The cameras of a flight as they really are; those of an ideal scenario are as calibrated."""
    if scenario.realism != "default":
        return dict(mounts)
    return {name: true_mount(mount, seeding.stream(seed, f"calibration_{name}")) for name, mount in mounts.items()}


def true_mount(mount: CameraMount, rng: np.random.Generator) -> CameraMount:
    """The camera as it really is, for a calibration with errors drawn from `rng`.

    Args:
        mount: the camera as calibrated.
        rng: the camera's own stream; each error is cut off at two sigma, as a worse calibration would be repeated.
    """
    draw = np.clip(rng.standard_normal(8), -2.0, 2.0)
    camera = dataclasses.replace(
        mount.camera,
        fx=mount.camera.fx * (1 + FOCAL_ERROR * draw[0]), fy=mount.camera.fy * (1 + FOCAL_ERROR * draw[1]),
        cx=mount.camera.cx + CENTRE_ERROR * draw[2], cy=mount.camera.cy + CENTRE_ERROR * draw[3])
    return dataclasses.replace(
        mount, camera=camera, R_BC=mount.R_BC @ so3.exp(ATTITUDE_ERROR / np.sqrt(3) * draw[4:7]),
        stamp_offset=mount.stamp_offset + TIME_ERROR * draw[7])
