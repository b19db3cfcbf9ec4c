"""Mirrors `perch_perception.powerline_mapper_node`: rendered images of the front camera to maps of powerlines."""

from __future__ import annotations

import numpy as np
from perch_msgs.msg import PowerlineArray

from perch_core.camera import CameraMount
from perch_core.surface import PerchSurface
from perch_perception.line_mapping import LineMapper, detect_lines, place
from perch_perception.pose_buffer import BodyState, PoseBuffer, StampError
from perch_perception.powerline_mapper_node import PowerlineMapperConfig, map_message
from perch_sim.camera_stream import Delivery
from perch_sim.state_history import StateHistory


class LineSource:
    """Owns the mapper."""

    def __init__(self, params: PowerlineMapperConfig, mount: CameraMount) -> None:
        self._params, self._mount = params, mount
        self._mapper, self._buffer = LineMapper(params.mapper), PoseBuffer(reach=0.0)
        self._handled = self._used = -np.inf

    def add_odometry(self, state: BodyState) -> None:
        """Take one estimate in."""
        self._buffer.add(state)

    def exposed(self, delivery: Delivery) -> float:
        """Middle of a frame's exposure on the board's clock [s]."""
        stamp = delivery.frame.stamp
        return round(stamp // 1_000_000_000 + 1e-9 * (stamp % 1_000_000_000) - self._mount.stamp_offset, 9)

    def covers(self, delivery: Delivery) -> bool:
        """Whether the odometry has passed a frame's exposure."""
        return self.exposed(delivery) <= self._buffer.newest

    def answer(self, delivery: Delivery, truth: StateHistory, pad: PerchSurface) -> PowerlineArray | None:
        """The map as published for one frame; None where the frame is not used."""
        exposed = self.exposed(delivery)
        if exposed <= self._handled:
            return None
        self._handled = exposed
        if exposed - self._used < 1.0 / self._params.rate - 1e-3:
            return None
        self._used = exposed
        try:
            body = self._buffer.at(exposed)
        except StampError as error:
            return map_message(self._mapper.map(exposed), exposed, str(error))
        sigma = float(np.sqrt(np.linalg.eigvalsh(body.covariance[:3, :3])[-1]))
        if sigma > self._params.max_pose_sigma:
            problem = f"the odometry is known to {sigma:.2f} m only: nothing is mapped"
            return map_message(self._mapper.map(exposed), exposed, problem)
        sightings = detect_lines(delivery.image.result(), self._mount.camera, self._params.detection)
        return map_message(self._mapper.update(exposed, body, [place(one, body, self._mount) for one in sightings]), exposed)
