"""What the mirrors of the camera nodes share: images wait until the odometry has passed their exposure."""

from __future__ import annotations

import numpy as np

from perch_core.camera import CameraMount
from perch_eval.in_process.stamps import seconds
from perch_perception.pose_buffer import BodyState, PoseBuffer
from perch_sim.camera_stream import Delivery


class FrameSource:
    """Mirrors the intake of `perch_perception.ros.camera_node`."""

    def __init__(self, mount: CameraMount) -> None:
        self._mount, self._buffer = mount, PoseBuffer(reach=0.0)
        self._handled = -np.inf

    def add_odometry(self, state: BodyState) -> None:
        """Take one estimate in."""
        self._buffer.add(state)

    def exposed(self, delivery: Delivery) -> float:
        """Middle of a frame's exposure on the board's clock [s]."""
        return round(seconds(delivery.frame.stamp) - self._mount.stamp_offset, 9)

    def covers(self, delivery: Delivery) -> bool:
        """Whether the odometry has passed a frame's exposure."""
        return self.exposed(delivery) <= self._buffer.newest

    def fresh(self, exposed: float) -> bool:
        """Whether an exposure [s] is newer than all before it, which is noted."""
        if exposed <= self._handled:
            return False
        self._handled = exposed
        return True
