"""Node `recorder`: writes the main topics of a flight to an MCAP file."""

from __future__ import annotations

import time
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
    TargetDetection, Trajectory)
from rclpy.clock import Clock, ClockType
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import CompressedImage, Image, Imu

from perch_core.config import quantity, text
from perch_core.ros.backlog import Backlog
from perch_core.ros.lockstep import Participant
from perch_core.ros.node import PerchNode, spin_main
from perch_core.ros.wire import StepReading, stamp_of
from perch_core.timing import TICK_STEPS
from perch_eval.mcap_log import McapLog, type_name

TOPICS = {
    "ground_truth/odometry": Odometry, "ground_truth/target": PoseStamped, "contact": Contact,
    "imu/data_raw": Imu, "rotor_state": RotorState, "motor_command": MotorCommand,
    "odometry": Odometry, "vio/odometry": Odometry, "estimator/status": EstimatorStatus,
    "target/pose": PoseWithCovarianceStamped, "target/detections": TargetDetection, "powerlines": PowerlineArray,
    "trajectory": Trajectory, "recovery": Trajectory, "controller/command": ControllerCommand,
    "controller/status": ControllerStatus,
    "controller/reference": ControlReference, "/diagnostics": DiagnosticArray,
}
NOT_LATCHED = {"/diagnostics"}
TRUTH = "ground_truth/odometry"
REPORT_STEPS = 50
LOOK = 0.1      # [s] wall clock; messages are written with each tick, and this often where none comes
PATIENCE = 5.0  # [s] wall clock; messages that were sent long ago and have not come in this time never will


@dataclass(frozen=True, kw_only=True)
class RecorderParameters:
    """Parameters of the node `recorder`."""

    file: str = text("flight.mcap", doc="where to write")
    image_rate: float = quantity(6.0, unit="Hz", low=0.0, high=60.0, doc="images kept per second and camera, 0: none")
    every_step: tuple[str, ...] = quantity((), doc="topics with a message at every step: the flight does not go on before they are on file")
    image_quality: int = quantity(80, unit="%", low=10, high=100, doc="JPEG quality")


class RecorderNode(PerchNode[RecorderParameters]):
    """Takes messages as they are on the wire and writes them with simulation time.

    In lockstep it is a slow participant without results: its reports keep the vehicle from running away from it.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("recorder", RecorderParameters, **kwargs)
        self._log = McapLog(Path(self.params.file))
        self._counts = {topic: 0 for topic in (TRUTH, *self.params.every_step) if topic}
        self._waiting: StepReading | None = None
        self._waiting_since = 0.0
        self._next_image: dict[str, int] = {}
        self._backlogs: list[tuple[str, str, Backlog]] = []
        for topic, msg_type in TOPICS.items():
            # Latched, because discovery may find a publisher only after its first messages.
            durability = DurabilityPolicy.VOLATILE if topic in NOT_LATCHED else DurabilityPolicy.TRANSIENT_LOCAL
            profile = QoSProfile(depth=2000, reliability=ReliabilityPolicy.RELIABLE, durability=durability)
            resolved = self.resolve_topic_name(topic)
            self._log.add_topic(resolved, type_name(msg_type))
            self._backlogs.append((topic, resolved, self.create_backlog(msg_type, topic, profile)))
        if self.params.image_rate > 0.0:
            for camera in ("down", "front"):
                name = self.resolve_topic_name(f"camera_{camera}/image_raw/compressed")
                self._log.add_topic(name, type_name(CompressedImage))
                self.create_subscription(Image, f"camera_{camera}/image_raw", self._image_writer(name),
                                         QoSProfile(depth=5, reliability=ReliabilityPolicy.RELIABLE), raw=True)
        self._participant = Participant(self, self._on_step, every=TICK_STEPS)
        self._participant.greet()
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(1.0, self._lose_patience, clock=steady)
        self.create_timer(LOOK, self._write, clock=steady)

    def _write(self) -> None:
        """Put on file what has come."""
        for topic, resolved, backlog in self._backlogs:
            messages = backlog.take()
            for data in messages:
                self._log.write(resolved, data, stamp_of(data))
            if topic in self._counts:
                self._counts[topic] += len(messages)
        self._report()

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

    def _on_step(self, step: StepReading) -> None:
        if step.lockstep and step.index % REPORT_STEPS == 0:
            self._waiting, self._waiting_since = step, time.monotonic()
        self._write()

    def _report(self) -> None:
        """Report the tick once the truth of its step is on file, and what the nodes sent in all steps before."""
        if self._waiting is not None and self._counts[TRUTH] > self._waiting.index and min(self._counts.values()) >= self._waiting.index:
            step, self._waiting = self._waiting, None
            self._participant.report(step.stamp)

    def _lose_patience(self) -> None:
        """A node that has fallen silent must not stop the flight, which may yet end safely without it."""
        if self._waiting is None or time.monotonic() - self._waiting_since < PATIENCE or self._counts[TRUTH] <= self._waiting.index:
            return
        for topic in [topic for topic, count in self._counts.items() if count < self._waiting.index]:
            self.get_logger().warning(f"{topic} is incomplete: {self._counts.pop(topic)} messages in {self._waiting.index} steps")
        self._report()

    def close(self) -> None:
        """Finish the file with what has come since the last tick."""
        self._write()
        self._log.close()


def create(**kwargs: Any) -> RecorderNode:
    """The node, alone or composed."""
    return RecorderNode(**kwargs)


def main() -> None:
    """Entry point of `ros2 run perch_eval recorder`."""
    spin_main(create)


if __name__ == "__main__":
    main()
