"""The target localiser: images of the front camera in, the pose of the perching target in `map` out. [M:sec. IV-B]"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from perch_core import config, so3
from perch_core.camera import Region
from perch_core.camera_mount import CameraMount
from perch_core.component import Diagnostics, Output
from perch_core.covariance import largest_sigma
from perch_core.sensors import CalibrationSigmas
from perch_core.tag_board import load_board
from perch_core.values import CameraImage, TargetPose, TargetSighting, nanoseconds
from perch_perception.camera_component import PosedCameraComponent, extrinsics_parameter, images_parameter
from perch_perception.images import ImageError, check_image, mono_image
from perch_perception.pose_buffer import BodyState, StampError
from perch_perception.sensor_file import calibration_sigmas, sensors_parameter
from perch_perception.tags import (
    BoardLocalizer, BoardPose, FusedTarget, Localization, MapPose, fuse, start_fusion, to_map)

DIAGNOSTICS_PERIOD = 1.0  # [s]


@dataclass(frozen=True)
class TargetLocalizerConfig:
    """Parameters of the target localiser."""

    vehicle: str = config.text("snapdragon", doc="vehicle whose camera it is, config/vehicles/<name>.yaml")
    sensors: str = sensors_parameter()
    camera: str = config.text("front", doc="camera of the vehicle; its images are on camera_<name>/image_raw")
    images: str = images_parameter()
    extrinsics: str = extrinsics_parameter()
    board: str = config.text("pad_four_tags", doc="tag board, config/boards/<name>.yaml")
    mode: str = config.choice("joint", options=("joint", "average", "fused"),
                              doc="joint: latest image, all corners together; average: the paper's mean over the tags of "
                                  "the first complete image; fused: all images")
    max_position_sigma: float = config.quantity(0.10, unit="m", above=0.0, high=10.0,
                                                doc="worst axis, relative to the vehicle, with which target/pose is still published")
    max_attitude_sigma: float = config.quantity(5.0, unit="deg", above=0.0, high=180.0, doc="the same for the attitude")
    max_range: float = config.quantity(6.0, unit="m", above=0.0, high=100.0,
                                       doc="a board further away than this is taken for one of another size")
    calibration: CalibrationSigmas = config.derived(CalibrationSigmas())


class Localizer(Protocol):
    """Finds the board in an image: `BoardLocalizer`, or an error model in its place."""

    def process(self, image: Callable[[Region | None], np.ndarray], exposure_time: float, body: BodyState | None) -> Localization:
        """Localise the board.

        Args:
            image: returns the grey image, uint8 (height, width), in which the requested region is valid; None: the whole image.
            exposure_time: middle of its exposure [s].
            body: state of the vehicle at `exposure_time`, where it is known.
        """


class TargetLocalizer(PosedCameraComponent[TargetLocalizerConfig]):
    """Publishes `sighting` for every image, and `pose` whenever a new estimate of the target is accurate enough."""

    config_type = TargetLocalizerConfig

    pose = Output(TargetPose, "target/pose")
    sighting = Output(TargetSighting, "target/detections")

    def __init__(self, config: TargetLocalizerConfig, localizer: Localizer | None = None) -> None:
        """
        Args:
            config: parameters.
            localizer: finds the board; None: `BoardLocalizer`, once the camera is known.

        Raises:
            ConfigError: no such vehicle, camera or board.
        """
        super().__init__(replace(config, calibration=calibration_sigmas(config.sensors, config.camera, config.calibration)))
        self._board = load_board(config.board)
        self._injected_localizer, self._localizer = localizer, localizer
        self._averaged: MapPose | None = None  # by the first complete image
        self._fused: FusedTarget | None = None
        self._counts = {"images": 0, "found": 0, "complete": 0}
        self._last_diagnostics = -np.inf

    def use_camera(self, mount: CameraMount) -> None:
        """Create a localiser for the camera, unless one was given."""
        if self._injected_localizer is None:
            self._localizer = BoardLocalizer(self._board, mount, self.config.max_range, averaging=self.config.mode == "average",
                                             calibration=self.config.calibration)

    def restart(self) -> None:
        """Also discard the target."""
        super().restart()
        self._averaged = self._fused = None
        if self.mounted.mount is not None:
            self.use_camera(self.mounted.mount)

    def process_image(self, image: CameraImage, exposure_time: float) -> None:
        """Localise the board in one image, and publish the result."""
        body, problem = None, ""
        try:
            body = self.bodies.at(exposure_time)
        except StampError as error:
            problem = str(error)
        camera, localizer = self.mounted.known.camera, self._localizer
        assert localizer is not None  # it comes with the camera

        def pixels(region: Region | None = None) -> np.ndarray:
            return mono_image(image, camera, region)

        try:
            check_image(image, camera)
            result = localizer.process(pixels, exposure_time, body)
        except ImageError as error:
            result = Localization(None, message=str(error))
            self.warn(f"{self._topic}: {error}", 1.0)
        self._publish_sighting(result, body, exposure_time, problem)

    def refuse(self, image: CameraImage, exposure_time: float, reason: str) -> None:
        """Publish an empty sighting with the reason."""
        super().refuse(image, exposure_time, reason)
        self._publish_sighting(Localization(None, message=reason), None, exposure_time, "")

    def _publish_sighting(self, result: Localization, body: BodyState | None, exposure_time: float, problem: str) -> None:
        stamp = nanoseconds(exposure_time)
        self._counts["images"] += 1
        message = "; ".join(part for part in (result.message, problem if result.board is not None else "") if part)
        sighting = TargetSighting(stamp, False, None, None, (), 0.0, 0, self.config.mode, message)
        if result.board is not None:
            shown = result.average or result.board
            self._counts["complete"] += result.complete
            sighting = sighting._replace(ids=tuple(int(i) for i in shown.ids), reprojection_rms=float(shown.rms),
                                         pose_camera=_pose(stamp, shown.p_CS, shown.R_CS, shown.covariance))
            if body is not None:
                self._counts["found"] += 1
                sighting = self._update(result.board, result.average, body, sighting)
        self.sighting(sighting)
        if exposure_time - self._last_diagnostics >= DIAGNOSTICS_PERIOD or exposure_time < self._last_diagnostics:
            self._last_diagnostics = exposure_time
            self.diagnostics(Diagnostics(stamp, {**self._counts, "dropped": self.dropped, "mode": self.config.mode},
                                         1 if message else 0, message or "ok"))

    def _update(self, board: BoardPose, average: BoardPose | None, body: BodyState, sighting: TargetSighting) -> TargetSighting:
        """Update the target by the mode, and publish its pose where it is accurate enough."""
        measured = to_map(average or board, body, self.mounted.known, self.config.calibration)
        target: FusedTarget | MapPose = measured
        is_new, frames, method = True, 1, self.config.mode
        if method == "fused":
            self._fuse(measured)
            if self._fused is not None:
                target, frames = self._fused, self._fused.frames
        elif method == "average":
            is_new = self._averaged is None and average is not None and self._is_accurate(measured.covariance)  # the first good complete image, once
            if is_new:
                self._averaged = measured
            elif self._averaged is None and average is None:
                method = "joint"  # not all tags yet: this is no average
            target = self._averaged or measured
        pose = _pose(sighting.stamp, target.p_WS, target.R_WS, target.covariance)
        if is_new and self._is_accurate(target.covariance):
            self.pose(pose)
        return sighting._replace(found=True, pose=pose, frames_fused=frames, method=method)

    def _fuse(self, measured: MapPose) -> None:
        if self._fused is not None:
            self._fused = fuse(self._fused, measured)
        elif self._is_accurate(measured.covariance):
            self._fused = start_fusion(measured)

    def _is_accurate(self, covariance: np.ndarray) -> bool:
        """Whether the worst axes of position and attitude are known within the limits."""
        position, attitude = largest_sigma(covariance[:3, :3]), largest_sigma(covariance[3:, 3:])
        return bool(position <= self.config.max_position_sigma and attitude <= np.radians(self.config.max_attitude_sigma))


def _pose(stamp: int, p: np.ndarray, R: np.ndarray, covariance: np.ndarray) -> TargetPose:
    return TargetPose(stamp, np.asarray(p, float), so3.quat_from_matrix(R), np.asarray(covariance, float))
