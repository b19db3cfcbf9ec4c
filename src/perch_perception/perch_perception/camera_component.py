"""Base classes of components that use a camera: images are queued until they can be used, and are used in order."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import deque
from typing import Protocol, TypeVar

import cv2
import numpy as np

from perch_core import config
from perch_core.camera_mount import CameraMount
from perch_core.component import Component, Diagnostics, Input
from perch_core.errors import ConfigError
from perch_core.values import CameraImage, CameraModel, OdometryState, Transform, seconds
from perch_core.vehicle import load_vehicle
from perch_perception.mounted_camera import MountedCamera
from perch_perception.pose_buffer import BodyState, PoseBuffer
from perch_perception.sensor_file import camera_mounts
from perch_perception.stamp_guard import StampGuard, StampVerdict
from perch_perception.world_frames import is_world

MAX_QUEUED = 10       # images; beyond that the oldest is dropped
MAX_STAMP_LEAD = 0.5  # an image whose stamp is further ahead of the odometry is refused [s]
SILENCE = 2_000_000_000  # without an image, after which that is reported [ns]


class CameraConfig(Protocol):
    """Parameters that every camera component has."""

    @property
    def vehicle(self) -> str: ...
    @property
    def sensors(self) -> str: ...
    @property
    def camera(self) -> str: ...
    @property
    def images(self) -> str: ...
    @property
    def extrinsics(self) -> str: ...


def images_parameter() -> str:
    """Declares the parameter `images`."""
    return config.choice("image_raw", options=("image_raw", "image_raw/compressed"), doc="topic of the images below camera_<name>/")


def extrinsics_parameter() -> str:
    """Declares the parameter `extrinsics`."""
    return config.choice("file", options=("file", "tf"), doc=(
        "where the camera sits: file: as the vehicle file says; tf: where /tf_static has its optical frame in base_link"))


C = TypeVar("C", bound=CameraConfig)


class CameraComponent(Component[C], ABC):
    """Queues each image until the camera is known and the image is covered, then passes it to `use`, in the order of arrival."""

    image = Input(CameraImage, "camera_{camera}/{images}")
    camera_info = Input(CameraModel, "camera_{camera}/camera_info")
    transform = Input(Transform, "/tf_static")

    def __init__(self, config: C) -> None:
        """
        Raises:
            ConfigError: the vehicle or sensor file has no such camera, or this component cannot use it.
        """
        super().__init__(config)
        cv2.setNumThreads(1)
        mounts = camera_mounts(config.sensors)
        self._calibrated = bool(mounts)
        mounts = mounts or load_vehicle(config.vehicle).mounts
        usable = [camera for camera, mount in mounts.items() if self.rejection_reason(mount) == ""]
        if config.camera not in usable:
            mount = mounts.get(config.camera)
            why = "not there" if mount is None else self.rejection_reason(mount)
            raise ConfigError("parameters", "camera",
                              f"{config.camera!r} of {config.sensors if self._calibrated else config.vehicle} is {why}; usable: {', '.join(usable) or 'none'}")
        self.mounted = MountedCamera(mounts[config.camera], self._calibrated, config.extrinsics, self.warn)
        self.dropped = 0
        self._queue: deque[CameraImage] = deque()
        self._now: int | None = None  # newest stamp of IMU or odometry [ns]
        self._heard: int | None = None  # that stamp when the last image came, or its absence was reported
        self._topic = self._channel("image")

    def warm_up(self) -> None:
        """Load the compiled lens model ahead of the first image."""
        camera = self.mounted.nominal.camera
        rays = camera.unproject(np.zeros((1, 2)))
        camera.project(rays), camera.project_jacobian(rays)

    def rejection_reason(self, mount: CameraMount) -> str:
        """Return the reason why this component cannot use a camera; empty where it can."""
        return ""

    @property
    def missing(self) -> str:
        """Description of what all images wait for; empty once it has come."""
        return self.mounted.missing

    @abstractmethod
    def use_camera(self, mount: CameraMount) -> None:
        """Called when the camera has become known or has changed."""

    @abstractmethod
    def is_ready(self, image: CameraImage) -> bool:
        """Whether all data that an image requires have been received, or cannot be expected any more."""

    @abstractmethod
    def use(self, image: CameraImage) -> None:
        """Process or refuse one image."""

    def on_camera_info(self, model: CameraModel) -> None:
        """Take the camera's intrinsics; those of a sensor file take precedence."""
        if self._calibrated:
            model = model._replace(camera=self.mounted.nominal.camera)
        if self.mounted.take_model(model):
            self.use_camera(self.mounted.known)
        self.advance()

    def on_transform(self, transform: Transform) -> None:
        """Take a static transform, which may be that of the camera's frame."""
        if self.mounted.take_transform(transform):
            self.use_camera(self.mounted.known)
        self.advance()

    def on_image(self, image: CameraImage) -> None:
        """Queue an image, and use all images that can be used."""
        self._heard = self._now
        if self._calibrated and self.mounted.mount is None:
            self.on_camera_info(CameraModel(image.stamp, image.frame, self.mounted.nominal.camera))
        self.mounted.check_image_frame(self._topic, image.frame)
        self._queue.append(image)
        if len(self._queue) > MAX_QUEUED:
            self._queue.popleft()
            self.dropped += 1
            reason = f" ({self.missing})" if self.missing else ""
            self.warn(f"{self._topic}: more than {MAX_QUEUED} images are waiting{reason}: the oldest are dropped", 1.0)
        if self.mounted.missing:
            self.warn(f"{self._topic}: images are not used: {self.mounted.missing}", 1.0)
        self.advance()

    def advance(self) -> None:
        """Use the queued images that are covered."""
        while self._queue and self.mounted.mount is not None and self.is_ready(self._queue[0]):
            self.use(self._queue.popleft())

    def clear_queue(self) -> None:
        """Drop all queued images, e.g. after a restart of their data source."""
        self._queue.clear()
        self._heard = None

    def note_time(self, now: int) -> None:
        """Report, in log and diagnostics, that no image has come for `SILENCE`; `now`: newest stamp of IMU or odometry [ns]."""
        self._now = now
        if self._heard is None:
            self._heard = now
        elif now - self._heard >= SILENCE:
            self._heard, text = now, f"{self._topic}: no image for {1e-9 * SILENCE:g} s"
            self.warn(text, 1.0)
            self.diagnostics(Diagnostics(now, {"dropped": self.dropped}, 1, text))

    def _channel(self, port: str) -> str:
        return getattr(type(self), port).channel(self)


class PosedCameraComponent(CameraComponent[C]):
    """Camera component that uses an image once the odometry has passed its exposure.

    Image and odometry arrive on different topics, in an order that depends on the machine. As an image is processed only once the
    state after its exposure is known, the result does not depend on this order.
    """

    odometry = Input(OdometryState, "odometry", lazy=True)

    def __init__(self, config: C) -> None:
        super().__init__(config)
        self._guard = StampGuard()
        self._begin()

    def _begin(self) -> None:
        self.bodies = PoseBuffer()
        self._last = -math.inf  # exposure of the last image used

    @abstractmethod
    def process_image(self, image: CameraImage, exposure_time: float) -> None:
        """Use one image.

        Args:
            image: its pixels are rendered or decoded on access.
            exposure_time: middle of its exposure on the IMU's clock [s].
        """

    def refuse(self, image: CameraImage, exposure_time: float, reason: str) -> None:
        """Report that an image cannot be used."""
        self.warn(f"{self._topic}: {reason}", 1.0)

    @property
    def missing(self) -> str:
        """Description of what all images wait for: the camera, or the first odometry."""
        return super().missing or ("" if len(self.bodies) else f"no {self._channel('odometry')} yet")

    def restart(self) -> None:
        """Discard all states and images after a restart of the odometry."""
        self._begin()
        self.clear_queue()

    def on_odometry(self, state: OdometryState) -> None:
        """Store the vehicle's state, and use the images that it covers."""
        if not is_world(state.frame):
            self.warn(f"odometry: frame {state.frame!r} is not a known fixed frame: ignored", 1.0)
            return
        verdict = self._guard.check(state.stamp)
        if verdict is StampVerdict.REFUSED:
            self.warn(f"odometry: stamp {state.stamp} ns does not follow {self._guard.last} ns: not used", 1.0)
            return
        if verdict is StampVerdict.RESTARTED:
            self.warn(f"odometry: stamp jump to {state.stamp} ns: restarting")
            self.restart()
        self.note_time(state.stamp)
        body = BodyState(seconds(state.stamp), np.array(state.p_WB), np.array(state.q_WB), np.array(state.v_WB), np.array(state.w_B),
                         state.pose_covariance)
        self.bodies.add(body if state.has_twist else self.bodies.with_twist(body))
        if self._queue:
            self.advance()

    def is_ready(self, image: CameraImage) -> bool:
        """Whether the odometry has passed the image's exposure, or the image must be refused."""
        exposure_time, newest = self._exposure_time(image), self.bodies.newest
        return exposure_time <= self._last or exposure_time <= newest or math.isfinite(newest) and exposure_time > newest + MAX_STAMP_LEAD

    def use(self, image: CameraImage) -> None:
        """Process an image, or refuse it where it is not newer than the last or is ahead of the odometry."""
        exposure_time, newest = self._exposure_time(image), self.bodies.newest
        if exposure_time <= self._last:
            self.refuse(image, exposure_time, f"image stamp {exposure_time:.4f} s is not newer than the last, {self._last:.4f} s")
        elif exposure_time > newest:
            self.refuse(image, exposure_time, f"image stamp {exposure_time:.4f} s is {exposure_time - newest:.2f} s ahead of the odometry")
        else:
            self._last = exposure_time
            self.process_image(image, exposure_time)

    def _exposure_time(self, image: CameraImage) -> float:
        return round(seconds(image.stamp) - self.mounted.nominal.stamp_offset, 9)
