"""Component `viewer`: serves the running flight to Foxglove by WebSocket, with markers of the scene."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from perch_core.component import Output
from perch_core.config import quantity, text
from perch_core.errors import PerchError
from perch_core.ros import topics
from perch_core.values import NANOSECONDS, AtEnd, CameraImage, Marker, Markers, OdometryState, Serialized
from perch_core.values.limits import problem
from perch_core.vehicle import load_vehicle
from perch_eval.extras import require
from perch_eval.ros.definitions import schema_of
from perch_eval.ros.listener import CAMERAS, Listener, subscribed_to
from perch_eval.ros.recorder import jpeg
from perch_eval.view.scene import (
    Path, map_markers, path_markers, plan_markers, target_markers, truth_markers, vehicle_markers, world_markers)
from perch_sim.scenario import load_scenario

FAST = ("odometry", "ground_truth/odometry", "imu/data_raw")
RARE = (
    "ground_truth/target", "contact", "rotor_state", "vio/odometry", "estimator/status", "target/pose", "target/detections", "powerlines",
    "trajectory", "controller/status", "controller/reference", *(f"camera_{camera}/camera_info" for camera in CAMERAS), "/tf_static",
    "robot_description")
UNLATCHED = ("/diagnostics", "/tf")  # of which later subscribers do not get the last message
LATCHED_DEPTH = {"/tf_static": 100, "contact": 100}
"""Number of messages kept for late subscribers, where it is more than one."""
MARKERS = "markers"
RATE, SCENE_RATE, IMAGE_RATE = 50.0, 20.0, 10.0
"""Rates per second of simulation: messages of the 500 Hz topics, markers, and, while subscribed, images of a camera [Hz]."""
IMAGE_QUALITY = 75  # of JPEG [%]
SLOW_SCENE = 5  # what does not move is sent with every so many scenes: later subscribers get it, too
LOCAL = (
    "http://localhost", "https://localhost", "http://127.0.0.1", "https://127.0.0.1", "http://[::1]", "file://", "https://app.foxglove.dev")


@dataclass(frozen=True, kw_only=True)
class ViewerParameters:
    """Parameters of the node `viewer`."""

    scenario: str = text("surface_90", doc="config/scenarios/<name>.yaml, or a file: vehicle, room, surface, cables")
    host: str = text("127.0.0.1", doc="address that is served; 0.0.0.0: to every machine that reaches this one")
    port: int = quantity(8765, low=0, high=65535, doc="of the WebSocket, 0: any free one")
    origins: tuple[str, ...] = text(
        LOCAL, doc="web pages that may connect, as scheme://host[:port], *: all; programs that are no browsers always may")


class _Pace:
    """Rate limiter by stamps, which also handles stamps that restart."""

    def __init__(self, rate: float) -> None:
        self._period, self._next = round(NANOSECONDS / rate), -1

    def __call__(self, stamp: int) -> bool:
        if self._next - 2 * self._period <= stamp < self._next:
            return False
        late = 0 <= self._next <= stamp
        self._next = max(self._next + self._period if late else 0, stamp + self._period // 2)
        return True


@subscribed_to((*FAST, *RARE, *UNLATCHED))
class Viewer(Listener[ViewerParameters]):
    """Forwards serialised messages, and publishes the scene as markers."""

    config_type = ViewerParameters

    markers = Output(Markers, MARKERS)

    def __init__(self, config: ViewerParameters) -> None:
        """
        Raises:
            ConfigError: no such scenario, or the address cannot be served.
        """
        super().__init__(config)
        scenario = load_scenario(config.scenario)
        self._vehicle = load_vehicle(scenario.vehicle)
        self._world = world_markers(scenario)
        self._plan: list[Marker] = []
        self._target: list[Marker] = []
        self._map: list[Marker] = []
        self._mapped: set[int] = set()
        self._truth = b""
        self._status = ""
        self._flown, self._true_path = Path(), Path()
        self._scene_pace, self._scenes = _Pace(SCENE_RATE), 0
        self._paces = {channel: _Pace(RATE) for channel in FAST}
        self._image_paces = {camera: _Pace(IMAGE_RATE) for camera in CAMERAS}
        require("view")
        from perch_eval.view.server import LiveServer

        self.server = LiveServer(config.host, config.port, f"perch: {scenario.name}", config.origins)

    def warm_up(self) -> None:
        """Log the address that is served."""
        self.info(f"ws://{self.config.host}:{self.server.port}")

    def on_message(self, channel: str, message: Serialized) -> None:
        """Forward a message, and use it for the scene if needed."""
        message = self.serialized(channel, message)
        pace = self._paces.get(channel)
        if pace is None or pace(message.stamp):
            self._send(message, LATCHED_DEPTH.get(channel, channel in RARE))
        try:
            self._update_scene(channel, message)
        except PerchError as error:
            self.warn(f"{channel} is not drawn: {error}", min_interval=1.0)

    def on_image(self, camera: str, image: CameraImage) -> None:
        """Forward an image as JPEG while its topic has subscribers."""
        channel = f"camera_{camera}/image_raw/compressed"
        topic = self.resolve(channel)
        self._declare(topic, topics.message_type(channel))
        if not self._image_paces[camera](image.stamp) or not self.server.has_subscribers(topic):
            return
        packed = jpeg(image, IMAGE_QUALITY)
        if packed is not None:
            self._send(self.serialized(channel, packed))

    def close(self) -> None:
        """End the connections."""
        self.server.close()

    def _declare(self, topic: str, message: type) -> None:
        if topic not in self.server:
            self.server.add_topic(topic, schema_of(message))

    def _send(self, message: Serialized, keep: int = 0) -> None:
        self._declare(message.topic, message.message)
        self.server.send(message.topic, message.data, message.stamp, keep)

    def _update_scene(self, channel: str, message: Serialized) -> None:
        """Keep the data of the scene; odometry triggers its drawing."""
        if channel == "odometry" and self._scene_pace(message.stamp):
            self._draw(_decoded(channel, message.data), message.stamp)
        elif channel == "ground_truth/odometry":
            self._truth = message.data
        elif channel == "trajectory":
            order = _decoded(channel, message.data)
            self._plan = plan_markers(order.trajectory, order.at_end == AtEnd.CONTACT)
        elif channel == "target/pose":
            pose = _decoded(channel, message.data)
            self._target = target_markers(pose.p_WS, pose.q_WS)
        elif channel == "powerlines":
            lines = _decoded(channel, message.data)
            self._mapped |= {line.id for line in lines.lines}
            self._map = map_markers(lines, self._mapped)
        elif channel == "controller/status":
            self._status = _decoded(channel, message.data).message

    def _draw(self, state: OdometryState, time: int) -> None:
        """Send the scene with the vehicle at a state; `time` is that of the scene [ns]."""
        self._flown.add(state.p_WB)
        found = vehicle_markers(self._vehicle, state, self._status)
        if self._truth:
            truth = _decoded("ground_truth/odometry", self._truth)
            self._true_path.add(truth.p_WB)
            found += truth_markers(self._vehicle, truth)
        if self._scenes % SLOW_SCENE == 0:
            found += self._world + self._plan + self._target + self._map + path_markers(self._flown, self._true_path)
        self._scenes += 1
        scene = Markers(time, tuple(found))
        self.markers(scene)
        self._send(self.serialized(MARKERS, scene))
        self.server.broadcast_time(time)


def _decoded(channel: str, data: bytes) -> Any:
    """Return the value of a serialised message.

    Raises:
        PerchError: it cannot be converted, or is beyond the limits of its type.
    """
    value = topics.decode(channel, data)
    if reason := problem(value):
        raise PerchError(reason)
    return value
