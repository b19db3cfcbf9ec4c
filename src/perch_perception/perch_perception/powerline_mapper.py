"""The powerline mapper: images of the front camera in, the map of powerlines out. [P:sec. VI]"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from perch_core import config
from perch_core.camera_mount import CameraMount
from perch_core.component import Diagnostics, Output
from perch_core.covariance import largest_sigma
from perch_core.sensors import CalibrationSigmas
from perch_core.values import CameraImage, PowerlineMap
from perch_perception.camera_component import PosedCameraComponent, extrinsics_parameter, images_parameter
from perch_perception.images import ImageError, mono_image, rgb_image
from perch_perception.line_mapping import BackgroundCheck, LineDetectionConfig, LineMapper, MapperConfig, detect_lines, place
from perch_perception.pose_buffer import BodyState, PoseBuffer, StampError
from perch_perception.sensor_file import calibration_sigmas, sensors_parameter

MAX_POSE_SIGMA = 2.0  # of odometry that maps [m]
DIAGNOSTICS_PERIOD = 1.0  # [s]


@dataclass(frozen=True)
class PowerlineMapperConfig:
    """Parameters of the powerline mapper."""

    vehicle: str = config.text("rpg", doc="vehicle whose camera it is, config/vehicles/<name>.yaml")
    sensors: str = sensors_parameter()
    camera: str = config.text("front", doc="camera of the vehicle, colour for red wires; its images are on camera_<name>/image_raw")
    images: str = images_parameter()
    extrinsics: str = extrinsics_parameter()
    rate: float = config.quantity(15.0, unit="Hz", above=0.0, high=60.0, doc="images used per second")
    detection: LineDetectionConfig = config.part(LineDetectionConfig)
    mapper: MapperConfig = config.part(MapperConfig)


class PowerlineMapper(PosedCameraComponent[PowerlineMapperConfig]):
    """Publishes the whole map for every image that is used, at most `rate` images per second."""

    config_type = PowerlineMapperConfig

    powerlines = Output(PowerlineMap, "powerlines")

    def __init__(self, config: PowerlineMapperConfig) -> None:
        m = config.mapper
        rotation = calibration_sigmas(config.sensors, config.camera, CalibrationSigmas()).rotation
        super().__init__(replace(config, mapper=replace(m, triangulation=replace(m.triangulation, mount_rotation=rotation))))
        self._pixels = rgb_image if config.detection.appearance == "red" else mono_image
        self._images, self._last_diagnostics = 0, -np.inf
        self._reset()

    def _reset(self) -> None:
        self._mapper, self._last_used = LineMapper(self.config.mapper), -np.inf
        self._background_check: BackgroundCheck | None = None
        if self.mounted.mount is not None:
            self.use_camera(self.mounted.mount)

    def rejection_reason(self, mount: CameraMount) -> str:
        """Return the reason why a camera cannot be used; empty where it can: red wires require a colour camera."""
        return "no colour camera" if self.config.detection.appearance == "red" and not mount.colour else ""

    def use_camera(self, mount: CameraMount) -> None:
        """Start a new backdrop: images of different cameras are not compared."""
        self._background_check = BackgroundCheck(mount.camera) if self.config.detection.appearance == "plain" else None

    def restart(self) -> None:
        """Also discard the map."""
        super().restart()
        self._reset()

    def process_image(self, image: CameraImage, exposure_time: float) -> None:
        """Map one image, unless it exceeds `rate`, and publish the map."""
        if exposure_time - self._last_used < 1.0 / self.config.rate - 1e-3:
            return
        self._last_used = exposure_time
        mount = self.mounted.known
        try:
            body = mapping_pose(self.bodies, exposure_time, MAX_POSE_SIGMA)
            pixels = self._pixels(image, mount.camera)
            sightings = detect_lines(pixels, mount.camera, self.config.detection)
            if self._background_check is not None:
                self._background_check.add_image(pixels, exposure_time, *mount.pose(body.p_WB - body.corrected, body.R_WB))
            powerline_map = self._mapper.update(exposure_time, body, [place(one, body, mount) for one in sightings],
                                                self._background_check.is_on_surface if self._background_check is not None else None)
            self._images += 1
        except (ImageError, StampError) as error:
            powerline_map = self._mapper.map(exposure_time)
            powerline_map = powerline_map._replace(message=f"{error}; {powerline_map.message}" if powerline_map.message else str(error))
            self.warn(f"{self._topic}: {error}", 1.0)
        self.powerlines(powerline_map)
        if exposure_time - self._last_diagnostics >= DIAGNOSTICS_PERIOD or exposure_time < self._last_diagnostics:
            self._last_diagnostics = exposure_time
            self.diagnostics(Diagnostics(powerline_map.stamp, {"images": self._images, "lines": len(powerline_map.lines),
                                                               "dropped": self.dropped},
                                         1 if powerline_map.message else 0, powerline_map.message or "ok"))


def mapping_pose(poses: PoseBuffer, exposure_time: float, max_sigma: float) -> BodyState:
    """Return the vehicle's state at an exposure [s], where its position is known well enough for mapping.

    Raises:
        StampError: there is no state at this stamp, or its position is less certain than `max_sigma` [m].
    """
    body = poses.at(exposure_time)
    sigma = largest_sigma(body.covariance[:3, :3])
    if sigma > max_sigma:
        raise StampError(f"position uncertainty {sigma:.2f} m exceeds {max_sigma:g} m: mapping paused")
    return body
