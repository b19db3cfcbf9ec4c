"""The perception components, connected as in the ROS graph: outputs are delivered at once, without a clock."""

from __future__ import annotations

import time
from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from perch_core import config
from perch_core.component import Component, LogLine
from perch_core.sensors import Sensors
from perch_core.tag_board import load_board
from perch_core.values import (CameraImage, CameraModel, ImuSample, InertialState, OdometryState, PowerlineMap,
                               TargetPose, TargetSighting)
from perch_eval.node_launch import read_parameters
from perch_eval.recordings.image_detections import Gallery, GalleryImage, canvas, caption, draw_board, draw_wires
from perch_eval.recordings.recording import Event
from perch_perception.camera_component import CameraComponent
from perch_perception.estimator_component import StateEstimator
from perch_perception.line_mapping import detect_lines
from perch_perception.images import ImageError, mono_image
from perch_perception.powerline_mapper import PowerlineMapper
from perch_perception.target_localizer import TargetLocalizer
from perch_perception.vio import VioResult
from perch_perception.vio_component import VioComponent

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

T = TypeVar("T", bound="DataclassInstance")

MAX_POSITION_SIGMA = 100.0  # 1 sigma of a position that is kept [m]
TAIL = 8  # frames of history in a picture of tracks


class _Vio(VioComponent):
    """VIO component that draws some of its frames, and keeps of each the stamp [ns], the CPU time [s] and the result."""

    frames: list[tuple[int, float, VioResult]]
    gallery: Gallery

    def use(self, image: CameraImage) -> None:
        """Process an image as the base class does; record the frame and offer a picture."""
        drawn: list[CameraImage] = []
        self.debug_image.receivers[:] = [drawn.append] if self.gallery.due(TAIL) else []
        begin = time.process_time()
        super().use(image)
        r = self.result
        assert r is not None  # of this frame
        self.frames.append((image.stamp, time.process_time() - begin, r))
        text = f"{r.outcome.name.lower()}: {r.features} tracks, {r.used} used"

        def shown() -> GalleryImage | None:
            pixels = drawn[-1].pixels() if drawn else None
            return None if pixels is None else (text, pixels)

        self.gallery.offer(image.stamp, shown)


class _Target(TargetLocalizer):
    """Target localiser that draws some of the images with the board found, and a few without."""

    sightings: list[TargetSighting]
    found: Gallery
    missed: Gallery

    def process_image(self, image: CameraImage, exposure_time: float) -> None:
        """Process an image as the base class does and offer a picture."""
        super().process_image(image, exposure_time)
        sighting = self.sightings[-1]
        (self.missed if sighting.pose_camera is None else self.found).offer(image.stamp, lambda: self._drawn(image, sighting))

    def _drawn(self, image: CameraImage, sighting: TargetSighting) -> GalleryImage | None:
        camera = self.mounted.known.camera
        try:
            drawn = canvas(mono_image(image, camera))
        except ImageError:  # the node has reported it
            return None
        text = sighting.message
        if sighting.pose_camera is not None:
            draw_board(drawn, camera, load_board(self.config.board), sighting.pose_camera, sighting.ids)
            text = f"tags {list(sighting.ids)}, {np.linalg.norm(sighting.pose_camera.p_WS):.2f} m, rms {sighting.reprojection_rms:.2f} px"
        return caption(drawn, text)


class _Wires(PowerlineMapper):
    """Powerline mapper that draws some of the images with the detected wires."""

    gallery: Gallery

    def process_image(self, image: CameraImage, exposure_time: float) -> None:
        """Process an image as the base class does and offer a picture."""
        super().process_image(image, exposure_time)
        self.gallery.offer(image.stamp, lambda: self._drawn(image))

    def _drawn(self, image: CameraImage) -> GalleryImage | None:
        camera = self.mounted.known.camera
        try:
            wires = detect_lines(self._pixels(image, camera), camera, self.config.detection)
        except ImageError:  # the node has reported it
            return None
        drawn = canvas(mono_image(image, camera))
        draw_wires(drawn, camera, wires)
        return caption(drawn, f"{len(wires)} wires")


def node_config(node: str, config_type: type[T], given: Mapping[str, Any], overrides: Mapping[str, Mapping[str, Any]]) -> T:
    """Return the configuration of a node: that of `config/<node>.yaml`, the given dotted parameters, then the overrides.

    Raises:
        ConfigError: a parameter is refused.
    """
    parameters = config.flattened(read_parameters(node)) | dict(given) | config.flattened(overrides.get(node, {}))
    return config.from_mapping(config_type, config.nested(parameters), node)


class Perception:
    """VIO, estimator, target localiser and powerline mapper, and their outputs.

    Attributes:
        vio: the component of VIO.
        states: of VIO.
        odometry: of the estimator, one per IMU sample while its position sigma is below `MAX_POSITION_SIGMA`.
        sightings, targets: of the target localiser.
        lines: the newest powerline map; None: none yet.
        log: (node, level, text) of warnings and errors -> number of occurrences.
    """

    def __init__(self, sensors: Sensors, file: str, down: str, front: str, board: str, overrides: Mapping[str, Mapping[str, Any]],
                 without: Collection[str] = ()) -> None:
        """
        Args:
            sensors, file: cameras and IMU, and the file that describes them.
            down: camera of VIO.
            front: camera of target localiser and powerline mapper.
            board: tag board, config/boards/<name>.yaml or a file.
            overrides: node -> parameter -> value, over `config/<node>.yaml`.
            without: nodes that are left out.

        Raises:
            ConfigError: a parameter or a camera is refused.
        """
        self._sensors, self._overrides, self._without = sensors, overrides, without
        common = {"sensors": file}
        ahead = common | {"camera": front}
        wires = "red" if sensors.cameras[front].colour else "plain"
        self.vio: _Vio = self._make("vio", _Vio, common | {"camera": down, "level_ground": False})
        self.vio.frames, self.vio.gallery = [], Gallery()
        self.estimator: StateEstimator = self._make("estimator", StateEstimator, common)
        self.target: _Target | None = self._make("target_localizer", _Target, ahead | {"board": board})
        self.wires: _Wires | None = self._make("powerline_mapper", _Wires, ahead | {"detection.appearance": wires})
        self._camera_components: list[tuple[str, CameraComponent[Any] | None]] = [(down, self.vio), (front, self.target), (front, self.wires)]
        self.states: list[InertialState] = []
        self.odometry: list[OdometryState] = []
        self.sightings: list[TargetSighting] = []
        self.targets: list[TargetPose] = []
        self.lines: PowerlineMap | None = None
        self.log: dict[tuple[str, str, str], int] = {}
        self.vio.state.receivers += [self.states.append, self.estimator.on_vio_state]
        self.vio.odometry.receivers.append(self.estimator.on_vio_odometry)
        self.estimator.odometry.receivers.append(self._store_odometry)
        if self.target is not None:
            self.target.sightings, self.target.found, self.target.missed = self.sightings, Gallery(), Gallery(4)
            self.target.sighting.receivers.append(self.sightings.append)
            self.target.pose.receivers.append(self.targets.append)
            self.estimator.odometry.receivers.append(self.target.on_odometry)
        if self.wires is not None:
            self.wires.gallery = Gallery(6)
            self.wires.powerlines.receivers.append(lambda lines: setattr(self, "lines", lines))
            self.estimator.odometry.receivers.append(self.wires.on_odometry)

    def process(self, event: Event) -> None:
        """Pass a sensor's value to the components."""
        value = event.value
        if isinstance(value, ImuSample):
            self.estimator.on_imu(value)
            self.vio.on_imu(value)
            return
        for camera, component in self._camera_components:
            if component is not None and camera == event.source:
                component.on_camera_info(CameraModel(value.stamp, value.frame, self._sensors.cameras[camera].camera))
                component.on_image(value)

    def _make(self, node: str, cls: type[Component[Any]], given: Mapping[str, Any]) -> Any:
        """Create a component with the parameters of its node; None if it is left out."""
        if node in self._without:
            return None
        component = cls(node_config(node, cls.config_type, given, self._overrides))
        component.log.receivers.append(lambda line: self._record_log(node, line))
        return component

    def _store_odometry(self, odometry: OdometryState) -> None:
        if odometry.pose_covariance[0, 0] < MAX_POSITION_SIGMA**2:
            self.odometry.append(odometry)

    def _record_log(self, node: str, line: LogLine) -> None:
        key = (node, line.level, line.text)
        if line.level != "info" and (key in self.log or len(self.log) < 200):
            self.log[key] = self.log.get(key, 0) + 1
