"""The base of the nodes that look through one camera from where the vehicle was."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, TypeVar

import cv2
import numpy as np
from nav_msgs.msg import Odometry
from perch_core.camera import CameraMount
from perch_core.errors import ConfigError
from perch_core.ros import qos
from perch_core.ros.lockstep import Participant
from perch_core.ros.node import PerchNode
from perch_core.timing import TICK_STEPS
from perch_core.vehicle import load_vehicle
from rclpy.clock import Clock, ClockType
from sensor_msgs.msg import Image

from perch_perception.pending_images import LOOK, PendingImages
from perch_perception.pose_buffer import PoseBuffer
from perch_perception.ros.states import body_state

T = TypeVar("T")


class CameraNode(PerchNode[T], ABC):
    """Each image waits until the odometry has passed its exposure and is then given to `use`, in order.

    The parameters have `vehicle` and `camera`. A subclass makes what `use` needs, then calls `begin()`.
    """

    def __init__(self, name: str, parameters: type[T], **kwargs: Any) -> None:
        super().__init__(name, parameters, **kwargs)
        cv2.setNumThreads(1)
        mounts = load_vehicle(self.params.vehicle).mounts
        usable = [camera for camera, mount in mounts.items() if self.unusable(mount) == ""]
        if self.params.camera not in usable:
            mount = mounts.get(self.params.camera)
            why = "not there" if mount is None else self.unusable(mount)
            self.destroy_node()
            raise ConfigError(name, "camera", f"{self.params.camera!r} of {self.params.vehicle} is {why}; "
                              f"usable: {', '.join(usable) or 'none'}")
        self._mount: CameraMount = mounts[self.params.camera]
        self._buffer = PoseBuffer(reach=0.0)
        self._pending = PendingImages(self._mount.stamp_offset, self.use)
        self._participant = Participant(self, lambda _: self._take_odometry(), every=TICK_STEPS)
        self._odometry = self.create_backlog(Odometry, "odometry", qos.CHAIN)

    def begin(self) -> None:
        """Subscribe to the images and join the lockstep."""
        rays = self._mount.camera.unproject(np.zeros((1, 2)))  # loading what is compiled takes 0.2 s: not in flight
        self._mount.camera.project(rays), self._mount.camera.project_jacobian(rays)
        self.create_subscription(Image, f"camera_{self.params.camera}/image_raw", self._receive_image, qos.IMAGE)
        self.create_timer(LOOK, self._take_odometry, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._participant.greet()

    def unusable(self, mount: CameraMount) -> str:
        """Why this node cannot use a camera; empty when it can."""
        return ""

    @abstractmethod
    def use(self, msg: Image, exposed: float, refusal: str) -> None:
        """Use one image, and report to the lockstep, whatever happens.

        Args:
            msg: the image.
            exposed: middle of its exposure on the IMU's clock [s].
            refusal: why the image must not be used; empty when it may.
        """

    def _take_odometry(self) -> None:
        """Take the states that have come, and handle the images whose exposure they have passed."""
        for data in self._odometry.take():
            self._buffer.add(body_state(data))
        self._pending.advance(self._buffer.newest)

    def _receive_image(self, msg: Image) -> None:
        self._take_odometry()
        self._pending.add(msg, self._buffer.newest, keep_all=self._participant.lockstep is not False)
