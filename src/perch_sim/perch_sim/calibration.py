"""Differences between the true sensors and the vehicle's file, from which CameraInfo and the noise of the filters are taken.

No declared value holds exactly: in every flight each error has its own scale, between 1 / `SPREAD` and `SPREAD` times the
declared one, and calibration errors have heavier tails than a normal distribution.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np

from perch_core import so3
from perch_core.camera_mount import CameraMount
from perch_core.vehicle import ImuConfig
from perch_sim import seeding
from perch_sim.scenario import Scenario

# One sigma of a careful calibration of a unit of this size.
FOCAL_ERROR = 0.003                # of each focal length [-]
CENTRE_ERROR = 0.5                 # of the principal point [px]
ATTITUDE_ERROR = np.radians(0.5)   # of the mounting attitude, all axes together [rad]
TIME_ERROR = 0.002                 # of the stamp offset [s]
SPREAD = 1.5                       # scales are log-uniform between 1 / SPREAD and SPREAD of these, and of what is declared of the IMU
FREEDOM = 5                        # degrees of freedom of Student's t of a calibration error, scaled to unit variance
LARGEST = 4.0                      # such an error over its sigma: a worse calibration shows in its residuals, and is repeated


def _scales(rng: np.random.Generator, count: int) -> np.ndarray:
    return SPREAD ** rng.uniform(-1.0, 1.0, count)


def true_imu(imu: ImuConfig, seed: int) -> ImuConfig:
    """Return the true IMU of a flight: noise, bias walks and standard deviations of the turn-on biases."""
    names = ("accel_noise", "gyro_noise", "accel_bias_walk", "gyro_bias_walk", "accel_bias_init", "gyro_bias_init")
    scales = _scales(seeding.stream(seed, "imu_scales"), len(names)).tolist()
    return dataclasses.replace(imu, **{name: scale * getattr(imu, name) for name, scale in zip(names, scales)})


def true_mounts(scenario: Scenario, mounts: Mapping[str, CameraMount], seed: int) -> dict[str, CameraMount]:
    """Return the true cameras of a flight; those of an ideal scenario are as calibrated."""
    if scenario.realism != "default":
        return dict(mounts)
    return {name: true_mount(mount, seeding.stream(seed, f"calibration_{name}")) for name, mount in mounts.items()}


def true_mount(mount: CameraMount, rng: np.random.Generator) -> CameraMount:
    """Return the true camera, for a calibration with errors drawn from `rng`.

    Args:
        mount: the camera as calibrated.
        rng: random stream of this camera.
    """
    draw = np.clip(rng.standard_t(FREEDOM, 8) * np.sqrt(1 - 2 / FREEDOM), -LARGEST, LARGEST) * np.repeat(_scales(rng, 4), (2, 2, 3, 1))
    camera = dataclasses.replace(
        mount.camera,
        fx=mount.camera.fx * (1 + FOCAL_ERROR * draw[0]), fy=mount.camera.fy * (1 + FOCAL_ERROR * draw[1]),
        cx=mount.camera.cx + CENTRE_ERROR * draw[2], cy=mount.camera.cy + CENTRE_ERROR * draw[3])
    return dataclasses.replace(
        mount, camera=camera, R_BC=mount.R_BC @ so3.exp(ATTITUDE_ERROR / np.sqrt(3) * draw[4:7]),
        stamp_offset=mount.stamp_offset + TIME_ERROR * draw[7])
