"""Mirrors `perch_perception.powerline_mapper_node`: rendered images of the front camera to maps of powerlines."""

from __future__ import annotations

import numpy as np
from perch_msgs.msg import PowerlineArray

from perch_core.camera import CameraMount
from perch_eval.in_process.frame_source import FrameSource
from perch_perception.line_mapping import LineMapper, detect_lines, place
from perch_perception.pose_buffer import StampError
from perch_perception.powerline_mapper_node import PowerlineMapperConfig, map_message, mapping_pose
from perch_sim.camera_stream import Delivery


class LineSource(FrameSource):
    """Owns the mapper."""

    def __init__(self, params: PowerlineMapperConfig, mount: CameraMount) -> None:
        super().__init__(mount)
        self._params, self._mapper = params, LineMapper(params.mapper)
        self._used = -np.inf

    def answer(self, delivery: Delivery) -> PowerlineArray | None:
        """The map as published for one frame; None where the frame is not used."""
        exposed = self.exposed(delivery)
        if not self.fresh(exposed):
            return None
        if exposed - self._used < 1.0 / self._params.rate - 1e-3:
            return None
        self._used = exposed
        try:
            body = mapping_pose(self._buffer, exposed, self._params.max_pose_sigma)
        except StampError as error:
            return map_message(self._mapper.map(exposed), exposed, str(error))
        sightings = detect_lines(delivery.image.result(), self._mount.camera, self._params.detection)
        return map_message(self._mapper.update(exposed, body, [place(one, body, self._mount) for one in sightings]), exposed)
