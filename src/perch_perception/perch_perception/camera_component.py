"""Components that look through a camera: images wait until they can be used, and are used in order."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import deque
from typing import Protocol, TypeVar

import cv2
import numpy as np

from perch_core import config
from perch_core.camera_mount import CameraMount
from perch_core.component import Component, Input
from perch_core.errors import ConfigError
from perch_core.values import CameraImage, CameraModel, OdometryState, Transform, seconds
from perch_core.vehicle import load_vehicle
from perch_perception.mounted_camera import MountedCamera
from perch_perception.pose_buffer import BodyState, PoseBuffer
from perch_perception.sensor_file import camera_mounts
from perch_perception.stamp_guard import StampGuard, StampVerdict
from perch_perception.world_frames import is_world

MOST_WAITING = 10   # images; the oldest gives way to more
FUTURE = 0.5        # an image stamped this much ahead of the odometry cannot be right [s]


class CameraConfig(Protocol):
    """What the parameters of a camera's component hold."""

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
    """Holds each image back until the camera is known and the image is covered; then `use` gets it, in the order of arrival."""

    image = Input(CameraImage, "camera_{camera}/{images}")
    camera_info = Input(CameraModel, "camera_{camera}/camera_info")
    transform = Input(Transform, "/tf_static")

    def __init__(self, config: C) -> None:
        """
        Raises:
            ConfigError: the vehicle has no such camera, or it is unusable.
        """
        super().__init__(config)
        cv2.setNumThreads(1)
        mounts = camera_mounts(config.sensors)
        self._calibrated = bool(mounts)
        mounts = mounts or load_vehicle(config.vehicle).mounts
        usable = [camera for camera, mount in mounts.items() if self.unusable(mount) == ""]
        if config.camera not in usable:
            mount = mounts.get(config.camera)
            why = "not there" if mount is None else self.unusable(mount)
            raise ConfigError(type(self).__name__, "camera",
                              f"{config.camera!r} of {config.sensors if self._calibrated else config.vehicle} is {why}; usable: {', '.join(usable) or 'none'}")
        self.mounted = MountedCamera(mounts[config.camera], config.extrinsics, self.warn)
        self.dropped = 0
        self._waiting: deque[CameraImage] = deque()
        self._topic = self._channel("image")

    def warm_up(self) -> None:
        """Load the compiled lens."""
        camera = self.mounted.nominal.camera
        rays = camera.unproject(np.zeros((1, 2)))
        camera.project(rays), camera.project_jacobian(rays)

    def unusable(self, mount: CameraMount) -> str:
        """Why this component cannot use a camera; empty when it can."""
        return ""

    @abstractmethod
    def use_camera(self, mount: CameraMount) -> None:
        """The camera has become known, or is another one now."""

    @abstractmethod
    def covers(self, image: CameraImage) -> bool:
        """Whether all that an image needs is there, or the image cannot be waited for."""

    @abstractmethod
    def use(self, image: CameraImage) -> None:
        """Use, or refuse, one image."""

    def on_camera_info(self, model: CameraModel) -> None:
        """The camera's intrinsics; of a sensor file they are known."""
        if self._calibrated:
            model = model._replace(camera=self.mounted.nominal.camera)
        if self.mounted.take_model(model):
            self.use_camera(self.mounted.known)
        self.advance()

    def on_transform(self, transform: Transform) -> None:
        """Where a frame, perhaps the camera's, is in another."""
        if self.mounted.take_transform(transform):
            self.use_camera(self.mounted.known)
        self.advance()

    def on_image(self, image: CameraImage) -> None:
        """Keep an image, and use what can be."""
        if self._calibrated and self.mounted.mount is None:
            self.on_camera_info(CameraModel(image.stamp, image.frame, self.mounted.nominal.camera))
        self._waiting.append(image)
        if len(self._waiting) > MOST_WAITING:
            self._waiting.popleft()
            self.dropped += 1
            self.warn(f"{self._topic}: more than {MOST_WAITING} images wait: the oldest are dropped", 1.0)
        if self.mounted.missing:
            self.warn(f"{self._topic}: images are not used: {self.mounted.missing}", 1.0)
        self.advance()

    def advance(self) -> None:
        """Use the images that have become covered."""
        while self._waiting and self.mounted.mount is not None and self.covers(self._waiting[0]):
            self.use(self._waiting.popleft())

    def forget_images(self) -> None:
        """Drop what waits: it belongs to another time."""
        self._waiting.clear()

    def _channel(self, port: str) -> str:
        return getattr(type(self), port).channel(self)


class LocatedCameraComponent(CameraComponent[C]):
    """Images are used once the odometry has passed their exposure.

    Image and odometry come over different topics, and which is received first depends on the machine. An image that is handled
    only once the state after its exposure is known gives the same result whatever the order.
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
    def look(self, image: CameraImage, exposed: float) -> None:
        """Use one image.

        Args:
            image: its pixels are drawn or decoded when they are asked for.
            exposed: middle of its exposure on the IMU's clock [s].
        """

    def refuse(self, image: CameraImage, exposed: float, reason: str) -> None:
        """An image must not be used."""
        self.warn(f"{self._topic}: {reason}", 1.0)

    def restart(self) -> None:
        """Odometry has started anew: what was known is of another time."""
        self._begin()
        self.forget_images()

    def on_odometry(self, state: OdometryState) -> None:
        """Where the vehicle was; images may have waited for it."""
        if not is_world(state.frame):
            self.warn(f"odometry: frame {state.frame!r} is no fixed frame known here: not used", 1.0)
            return
        verdict = self._guard.judge(state.stamp)
        if verdict is StampVerdict.REFUSED:
            self.warn(f"odometry: stamp {state.stamp} ns does not follow {self._guard.last} ns: not used", 1.0)
            return
        if verdict is StampVerdict.RESTARTED:
            self.warn(f"odometry: stamps go on from {state.stamp} ns: starting anew")
            self.restart()
        self.bodies.add(BodyState(seconds(state.stamp), np.array(state.p_WB), np.array(state.q_WB), np.array(state.v_WB),
                                  np.array(state.w_B), state.pose_covariance))
        if self._waiting:
            self.advance()

    def covers(self, image: CameraImage) -> bool:
        """Whether the odometry has passed its exposure, or it must be refused."""
        exposed, newest = self._exposed(image), self.bodies.newest
        return exposed <= self._last or exposed <= newest or math.isfinite(newest) and exposed > newest + FUTURE

    def use(self, image: CameraImage) -> None:
        """Look at an image, or refuse it."""
        exposed, newest = self._exposed(image), self.bodies.newest
        if exposed <= self._last:
            self.refuse(image, exposed, f"image stamp {exposed:.4f} s is not newer than the last, {self._last:.4f} s")
        elif exposed > newest:
            self.refuse(image, exposed, f"image stamp {exposed:.4f} s is {exposed - newest:.2f} s ahead of the odometry")
        else:
            self._last = exposed
            self.look(image, exposed)

    def _exposed(self, image: CameraImage) -> float:
        return round(seconds(image.stamp) - self.mounted.nominal.stamp_offset, 9)
