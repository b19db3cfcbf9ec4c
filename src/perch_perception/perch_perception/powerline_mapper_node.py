"""Node `powerline_mapper`: images of the front camera in, the map of powerlines out. [P:sec. VI]"""

from __future__ import annotations

import time
from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
from perch_core import config
from perch_core.camera import CameraMount
from perch_core.covariance import largest_sigma
from perch_core.ros.conversions import to_point, to_stamp
from perch_core.ros.node import spin_main
from perch_msgs.msg import Powerline, PowerlineArray
from sensor_msgs.msg import Image

from perch_perception.images import ImageError, mono_image, rgb_image
from perch_perception.line_mapping import LineDetectionConfig, LineMap, LineMapper, MapperConfig, detect_lines, place
from perch_perception.pose_buffer import BodyState, PoseBuffer, StampError
from perch_perception.ros.camera_node import CameraNode

DIAGNOSTICS_PERIOD = 1.0  # [s]


@dataclass(frozen=True)
class PowerlineMapperConfig:
    """Parameters of the node."""

    vehicle: str = config.text("rpg", doc="vehicle whose camera it is, config/vehicles/<name>.yaml")
    camera: str = config.text("front", doc="camera of the vehicle, colour for red wires; its images are on camera_<name>/image_raw")
    rate: float = config.quantity(10.0, unit="Hz", above=0.0, high=60.0, doc="images used per second")
    max_pose_sigma: float = config.quantity(2.0, unit="m", above=0.0, high=10.0,
                                            doc="odometry less certain than this maps nothing")
    detection: LineDetectionConfig = config.part(LineDetectionConfig)
    mapper: MapperConfig = config.part(MapperConfig)


class PowerlineMapperNode(CameraNode[PowerlineMapperConfig]):
    """Publishes the whole map on `powerlines` for every image that is used; every image gets a step report."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("powerline_mapper", PowerlineMapperConfig, **kwargs)
        self._red = self.params.detection.appearance == "red"
        self._mapper = LineMapper(self.params.mapper)
        self._used = -np.inf
        self._costs: deque[float] = deque(maxlen=100)
        self._images, self._diagnosed = 0, -np.inf
        self._lines = self._participant.publisher(PowerlineArray, "powerlines")
        self.begin()

    def unusable(self, mount: CameraMount) -> str:
        """Red wires need colour."""
        return "no colour camera" if self.params.detection.appearance == "red" and not mount.colour else ""

    def use(self, msg: Image, exposed: float, refusal: str) -> None:
        """Map one image where it is its turn, publish, and report."""
        if not refusal and exposed - self._used >= 1.0 / self.params.rate - 1e-3:
            self._used = exposed
            begin = time.perf_counter()
            try:
                self._publish(self._map(msg, exposed), exposed)
            except (ImageError, StampError) as error:
                self._publish(self._mapper.map(exposed), exposed, str(error))
            self._costs.append(time.perf_counter() - begin)
        self._participant.report(msg.header.stamp)

    def _map(self, msg: Image, exposed: float) -> LineMap:
        image = (rgb_image if self._red else mono_image)(msg, self._mount.camera)
        body = mapping_pose(self._buffer, exposed, self.params.max_pose_sigma)
        self._images += 1
        sightings = detect_lines(image, self._mount.camera, self.params.detection)
        return self._mapper.update(exposed, body, [place(one, body, self._mount) for one in sightings])

    def _publish(self, lines: LineMap, exposed: float, problem: str = "") -> None:
        msg = map_message(lines, exposed, problem)
        self._lines.publish(msg)
        if exposed - self._diagnosed >= DIAGNOSTICS_PERIOD and self._costs:
            self._diagnosed = exposed
            costs = 1e3 * np.array(self._costs)
            values = {"images": self._images, "lines": len(msg.lines), "dropped": self._pending.dropped,
                      "cost_ms_median": float(np.median(costs)), "cost_ms_p99": float(np.percentile(costs, 99))}
            self.publish_diagnostics(exposed, values, 1 if msg.message else 0, msg.message or "ok")


def mapping_pose(poses: PoseBuffer, exposed: float, max_sigma: float) -> BodyState:
    """Where the vehicle was at an exposure [s], when that is known well enough to map.

    Raises:
        StampError: there is no pose at this stamp, or its position is less certain than `max_sigma` [m].
    """
    body = poses.at(exposed)
    sigma = largest_sigma(body.covariance[:3, :3])
    if sigma > max_sigma:
        raise StampError(f"the odometry is known to {sigma:.2f} m only: nothing is mapped")
    return body


def map_message(lines: LineMap, exposed: float, problem: str = "") -> PowerlineArray:
    """The map as published.

    Args:
        lines: what is known.
        exposed: middle of the last image's exposure [s].
        problem: why that image was not used; empty when it was.
    """
    msg = PowerlineArray(degenerate=lines.degenerate,
                         message="; ".join(part for part in (problem, lines.message) if part))
    msg.header.stamp, msg.header.frame_id = to_stamp(float(exposed)), "map"
    for line in lines.lines:
        start, end = line.segment.ends
        msg.lines.append(Powerline(
            id=int(line.segment.id), start=to_point(start), end=to_point(end), radius=float(line.segment.radius),
            covariance=line.covariance.astype(float).ravel(), direction_sigma=float(line.direction_sigma),
            observations=int(line.observations)))
    return msg


def create(**kwargs: Any) -> PowerlineMapperNode:
    """The node, for its own process or a composed one."""
    return PowerlineMapperNode(**kwargs)


def main() -> None:
    """Entry point of the executable `powerline_mapper`."""
    spin_main(create)
