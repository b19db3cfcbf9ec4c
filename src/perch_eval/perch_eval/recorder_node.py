"""Node `recorder`: writes the main topics of a flight to an MCAP file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from perch_msgs.msg import (
    Contact, ControllerCommand, ControllerStatus, ControlReference, EstimatorStatus, MotorCommand, PowerlineArray, RotorState,
    Step, TargetDetection, Trajectory)
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import CompressedImage, Image, Imu

from perch_core.config import quantity, text
from perch_core.ros.lockstep import Participant
from perch_core.ros.node import PerchNode, spin_main
from perch_eval.mcap_log import McapLog, stamp_of, type_name

TOPICS = {
    "ground_truth/odometry": Odometry, "ground_truth/target": PoseStamped, "contact": Contact,
    "imu/data_raw": Imu, "rotor_state": RotorState, "motor_command": MotorCommand,
    "odometry": Odometry, "vio/odometry": Odometry, "estimator/status": EstimatorStatus,
    "target/pose": PoseWithCovarianceStamped, "target/detections": TargetDetection, "powerlines": PowerlineArray,
    "trajectory": Trajectory, "controller/command": ControllerCommand, "controller/status": ControllerStatus,
    "controller/reference": ControlReference, "/diagnostics": DiagnosticArray,
}
LATCHED = {"ground_truth/target", "target/pose", "trajectory", "powerlines", "controller/command", "contact"}
TICK_STEPS = 50


@dataclass(frozen=True, kw_only=True)
class RecorderParameters:
    """Parameters of the node `recorder`."""

    file: str = text("flight.mcap", doc="where to write")
    image_rate: float = quantity(6.0, unit="Hz", low=0.0, high=60.0, doc="images kept per second and camera, 0: none")
    image_quality: int = quantity(80, unit="%", low=10, high=100, doc="JPEG quality")


class RecorderNode(PerchNode[RecorderParameters]):
    """Takes messages as they are on the wire and writes them with simulation time.

    In lockstep it is a slow participant without results: its reports keep the vehicle from running away from it.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("recorder", RecorderParameters, **kwargs)
        self._log = McapLog(Path(self.params.file))
        self._truth_steps = 0
        self._waiting: Step | None = None
        self._next_image: dict[str, int] = {}
        for topic, msg_type in TOPICS.items():
            durability = DurabilityPolicy.TRANSIENT_LOCAL if topic in LATCHED else DurabilityPolicy.VOLATILE
            profile = QoSProfile(depth=2000, reliability=ReliabilityPolicy.RELIABLE, durability=durability)
            resolved = self.resolve_topic_name(topic)
            self._log.add_topic(resolved, type_name(msg_type))
            self.create_subscription(msg_type, topic, self._writer(resolved), profile, raw=True)
        if self.params.image_rate > 0.0:
            for camera in ("down", "front"):
                name = self.resolve_topic_name(f"camera_{camera}/image_raw/compressed")
                self._log.add_topic(name, type_name(CompressedImage))
                self.create_subscription(Image, f"camera_{camera}/image_raw", self._image_writer(name),
                                         QoSProfile(depth=5, reliability=ReliabilityPolicy.RELIABLE), raw=True)
        self._participant = Participant(self, self._on_step)
        self._participant.greet()

    def _writer(self, topic: str):
        is_truth = topic.endswith("ground_truth/odometry")

        def write(data: bytes) -> None:
            self._log.write(topic, data, stamp_of(data))
            if is_truth:
                self._truth_steps += 1
                self._report()

        return write

    def _image_writer(self, topic: str):
        period = int(1e9 / self.params.image_rate)

        def write(data: bytes) -> None:
            stamp = stamp_of(data)
            if stamp < self._next_image.get(topic, 0):
                return
            self._next_image[topic] = stamp + period
            image = deserialize_message(data, Image)
            channels = 3 if image.encoding == "rgb8" else 1
            pixels = np.frombuffer(image.data, np.uint8).reshape(image.height, image.width, channels)
            bgr = pixels[..., ::-1] if channels == 3 else pixels
            _, jpeg = cv2.imencode(".jpg", np.ascontiguousarray(bgr), [cv2.IMWRITE_JPEG_QUALITY, self.params.image_quality])
            packed = CompressedImage(header=image.header, format="jpeg")
            packed.data = jpeg.tobytes()
            self._log.write(topic, serialize_message(packed), stamp)

        return write

    def _on_step(self, step: Step) -> None:
        if step.lockstep and step.index % TICK_STEPS == 0:
            self._waiting = step
            self._report()

    def _report(self) -> None:
        """Report the tick once the truth of its step is on file."""
        if self._waiting is not None and self._truth_steps > self._waiting.index:
            step, self._waiting = self._waiting, None
            self._participant.report(step.stamp)

    def close(self) -> None:
        """Finish the file."""
        self._log.close()


def create(**kwargs: Any) -> RecorderNode:
    """The node, alone or composed."""
    return RecorderNode(**kwargs)


def main() -> None:
    """Entry point of `ros2 run perch_eval recorder`."""
    spin_main(create)


if __name__ == "__main__":
    main()
