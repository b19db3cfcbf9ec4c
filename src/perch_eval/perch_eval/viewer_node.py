"""Node `viewer`: serves the running flight to Foxglove by WebSocket, with markers of what a person wants to see.

It is no participant of the lockstep: the flight does not wait for it, and is the same with and without it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from perch_msgs.msg import (
    Contact, ControllerStatus, ControlReference, EstimatorStatus, PowerlineArray, RotorState, TargetDetection, Trajectory)
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, Imu
from visualization_msgs.msg import Marker, MarkerArray

from perch_core import so3
from perch_core.config import quantity, text
from perch_core.errors import PerchError
from perch_core.ros import qos
from perch_core.ros.conversions import pose_arrays, to_stamp
from perch_core.ros.node import PerchNode, spin_main
from perch_core.ros.trajectories import from_message
from perch_core.ros.wire import read_odometry, stamp_of
from perch_core.scenario import load_scenario
from perch_core.vehicle import load_vehicle
from perch_eval.mcap_log import type_name
from perch_eval.view.markers import stamped
from perch_eval.view.scene import (
    Path, map_markers, path_markers, plan_markers, target_markers, truth_markers, vehicle_markers, world_markers)
from perch_eval.view.server import LiveServer

FAST = {"odometry": Odometry, "ground_truth/odometry": Odometry, "imu/data_raw": Imu}
RARE = {
    "ground_truth/target": PoseStamped, "contact": Contact, "rotor_state": RotorState, "vio/odometry": Odometry,
    "estimator/status": EstimatorStatus, "target/pose": PoseWithCovarianceStamped, "target/detections": TargetDetection,
    "powerlines": PowerlineArray, "trajectory": Trajectory, "controller/status": ControllerStatus,
    "controller/reference": ControlReference, "camera_front/camera_info": CameraInfo, "camera_down/camera_info": CameraInfo,
}
CAMERAS = ("front", "down")
MARKERS, DIAGNOSTICS = "markers", "/diagnostics"
SLOW_SCENE = 5  # what does not move is sent with every so many scenes: whoever comes late sees it too


@dataclass(frozen=True, kw_only=True)
class ViewerParameters:
    """Parameters of the node `viewer`."""

    scenario: str = text("surface_90", doc="config/scenarios/<name>.yaml, or a file: vehicle, room, surface, cables")
    host: str = text("127.0.0.1", doc="address that is served; 0.0.0.0: to every machine that reaches this one")
    port: int = quantity(8765, low=0, high=65535, doc="of the WebSocket, 0: any free one")
    rate: float = quantity(50.0, unit="Hz", above=0.0, high=1000.0, doc="messages per second of simulation of the 500 Hz topics")
    scene_rate: float = quantity(20.0, unit="Hz", above=0.0, high=100.0, doc="markers and frames per second of simulation")
    image_rate: float = quantity(10.0, unit="Hz", low=0.0, high=60.0, doc="images per second of simulation and camera, while somebody looks; 0: none")
    image_quality: int = quantity(75, unit="%", low=10, high=100, doc="JPEG quality")


class _Pace:
    """Lets a message through every so often, by the stamps."""

    def __init__(self, rate: float) -> None:
        self._period, self._next = round(1e9 / rate), -1

    def __call__(self, stamp: int) -> bool:
        if stamp < self._next:
            return False
        self._next = max(self._next + self._period, stamp + self._period // 2)
        return True


class ViewerNode(PerchNode[ViewerParameters]):
    """Passes messages on as they are on the wire, and draws the scene."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("viewer", ViewerParameters, **kwargs)
        params = self.params
        scenario = load_scenario(params.scenario)
        self._vehicle = load_vehicle(scenario.vehicle)
        self._world = world_markers(scenario)
        self._server = LiveServer(params.host, params.port, f"perch: {scenario.name}")
        self._plan: list[Marker] = []
        self._target: list[Marker] = []
        self._map: list[Marker] = []
        self._mapped: set[int] = set()
        self._truth_bytes = b""
        self._words = ""
        self._flown, self._true_path = Path(), Path()
        self._scene_pace, self._scenes = _Pace(params.scene_rate), 0
        self._markers = self.create_publisher(MarkerArray, MARKERS, qos.STATUS)
        self._server.add_topic(self.resolve_topic_name(MARKERS), type_name(MarkerArray))
        handlers = {"odometry": self._see_odometry, "ground_truth/odometry": self._see_truth, "trajectory": self._see_trajectory,
                    "target/pose": self._see_target, "powerlines": self._see_lines, "controller/status": self._see_status}
        for topic, msg_type in (FAST | RARE).items():
            pace = _Pace(params.rate) if topic in FAST else None
            self._serve(topic, msg_type, 5 if topic in FAST else 20, topic in RARE, pace, handlers.get(topic))
        self._serve(DIAGNOSTICS, DiagnosticArray, 10, False, None, None)
        if params.image_rate > 0.0:
            for camera in CAMERAS:
                self._serve_camera(camera)
        self.get_logger().info(f"ws://{params.host}:{self._server.port}")

    def _serve(self, topic: str, msg_type: type, depth: int, latched: bool, pace: _Pace | None, look: Any) -> None:
        """Pass a topic on; `look` gets every message as bytes."""
        resolved = self.resolve_topic_name(topic)
        self._server.add_topic(resolved, type_name(msg_type))

        def receive(data: bytes) -> None:
            if look is not None:
                look(data)
            stamp = stamp_of(data)
            if pace is None or pace(stamp):
                self._server.send(resolved, data, stamp, latched)

        durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
        # What is fast may get lost on the way to a person; the rest must not.
        reliability = ReliabilityPolicy.RELIABLE if latched else ReliabilityPolicy.BEST_EFFORT
        self.create_subscription(msg_type, topic, receive, QoSProfile(depth=depth, durability=durability, reliability=reliability), raw=True)

    def _serve_camera(self, camera: str) -> None:
        resolved = self.resolve_topic_name(f"camera_{camera}/image_raw/compressed")
        self._server.add_topic(resolved, type_name(CompressedImage))
        pace = _Pace(self.params.image_rate)

        def receive(data: bytes) -> None:
            stamp = stamp_of(data)
            if not pace(stamp) or not self._server.watched(resolved):
                return
            image = deserialize_message(data, Image)
            pixels = np.frombuffer(image.data, np.uint8).reshape(image.height, image.width, -1)
            _, jpeg = cv2.imencode(".jpg", np.ascontiguousarray(pixels[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, self.params.image_quality])
            packed = CompressedImage(header=image.header, format="jpeg")
            packed.data = jpeg.tobytes()
            self._server.send(resolved, serialize_message(packed), stamp)

        self.create_subscription(Image, f"camera_{camera}/image_raw", receive, qos.SENSOR, raw=True)

    # -- what the scene is made of -----------------------------------------------------------------------------------

    def _see_truth(self, data: bytes) -> None:
        self._truth_bytes = data

    def _see_trajectory(self, data: bytes) -> None:
        msg = deserialize_message(data, Trajectory)
        try:
            self._plan = plan_markers(from_message(msg), msg.at_end == Trajectory.AT_END_CONTACT)
        except PerchError as error:
            self.get_logger().warning(f"trajectory {msg.id} is not drawn: {error}")

    def _see_target(self, data: bytes) -> None:
        self._target = target_markers(*pose_arrays(deserialize_message(data, PoseWithCovarianceStamped).pose.pose))

    def _see_lines(self, data: bytes) -> None:
        msg = deserialize_message(data, PowerlineArray)
        self._mapped |= {line.id for line in msg.lines}
        self._map = map_markers(msg, self._mapped)

    def _see_status(self, data: bytes) -> None:
        self._words = deserialize_message(data, ControllerStatus).message

    def _see_odometry(self, data: bytes) -> None:
        stamp = stamp_of(data)
        if self._scene_pace(stamp):
            self._draw(stamp, data)

    def _draw(self, stamp: int, data: bytes) -> None:
        state = read_odometry(data)
        self._flown.add(state.p_WB)
        found = vehicle_markers(self._vehicle, state, self._words)
        if self._truth_bytes:
            truth = read_odometry(self._truth_bytes)
            self._true_path.add(truth.p_WB)
            found += truth_markers(self._vehicle, truth)
        if self._scenes % SLOW_SCENE == 0:
            found += self._world + self._plan + self._target + self._map + path_markers(self._flown, self._true_path)
        self._scenes += 1
        msg = MarkerArray(markers=stamped(found, to_stamp(stamp)))
        packed = serialize_message(msg)
        self._markers.publish(packed)
        self._server.send(self.resolve_topic_name(MARKERS), packed, stamp)
        mounts = [("base_link", f"camera_{name}_optical_frame", m.p_BC, so3.quat_from_matrix(m.R_BC)) for name, m in self._vehicle.mounts.items()]
        self._server.send_frames(stamp, [("map", "base_link", state.p_WB, state.q_WB), ("base_link", "imu_link", (0, 0, 0), (0, 0, 0, 1)), *mounts])
        self._server.tell_time(stamp)

    def close(self) -> None:
        """End the connections."""
        self._server.close()


def create(**kwargs: Any) -> ViewerNode:
    """The node, alone or composed."""
    return ViewerNode(**kwargs)


def main() -> None:
    """Entry point of `ros2 run perch_eval viewer`."""
    spin_main(create)


if __name__ == "__main__":
    main()
