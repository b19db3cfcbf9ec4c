"""Node `vio`: images of the downward camera and the IMU in, odometry and the whole state at 30 Hz out."""

from __future__ import annotations

import time
from collections import deque
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from nav_msgs.msg import Odometry
from perch_core import config, so3
from perch_core.errors import ConfigError
from perch_core.ros import qos
from perch_core.ros.conversions import fill_odometry, nanoseconds, to_point, to_quaternion, to_stamp, to_vector
from perch_core.ros.lockstep import Participant
from perch_core.ros.node import PerchNode, spin_main
from perch_core.ros.wire import read_imu
from perch_core.timing import TICK_STEPS
from perch_core.vehicle import load_vehicle
from perch_msgs.msg import VioState
from rclpy.clock import Clock, ClockType
from sensor_msgs.msg import Image, Imu
from std_msgs.msg import Header

from perch_perception.images import ImageError, mono_image
from perch_perception.ukf import ImuSample
from perch_perception.ukf.odometry import covariances
from perch_perception.vio import FrameOutcome, VioConfig, VioResult, VisualInertialOdometry
from perch_perception.vio.drawing import TrackPainter

DIAGNOSTICS_PERIOD = 1_000_000_000  # [ns]
LOOK = 0.05  # samples are taken with each image and tick, and this often where neither comes [s], wall clock
QUEUE = 2  # images that wait in real time; older ones give way


@dataclass(frozen=True)
class VioNodeConfig(VioConfig):
    """Parameters of the node: those of the odometry, and what it belongs to."""

    vehicle: str = config.text("snapdragon", doc="vehicle whose camera it is, config/vehicles/<name>.yaml")
    camera: str = config.text("down", doc="camera of the vehicle; its images are on camera_<name>/image_raw")
    start_position: tuple[float, float, float] = config.quantity(
        (0.0, 0.0, 0.0), unit="m", doc="ground point under the vehicle in map, as in a scenario's start")
    start_yaw_deg: float = config.quantity(0.0, unit="deg", low=-180.0, high=180.0, doc="heading at the start in map")


class VioNode(PerchNode[VioNodeConfig]):
    """Publishes `vio/odometry` and `vio/state` for every frame that gives a pose, and reports every frame to the lockstep."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("vio", VioNodeConfig, **kwargs)
        cv2.setNumThreads(1)
        try:
            vehicle = load_vehicle(self.params.vehicle)
            if self.params.camera not in vehicle.mounts:
                raise ConfigError("vio", "camera", f"{self.params.camera!r} is not one of {', '.join(vehicle.mounts)} "
                                  f"of {self.params.vehicle}")
        except ConfigError:
            self.destroy_node()
            raise
        self._mount = vehicle.mounts[self.params.camera]
        standing = np.array(self.params.start_position) + [0.0, 0.0, vehicle.standing_height]
        self._vio = VisualInertialOdometry(self.params, self._mount, standing, float(np.radians(self.params.start_yaw_deg)),
                                         float(self.params.start_position[2]))
        self._waiting: deque[Image] = deque()
        self._costs: deque[float] = deque(maxlen=300)
        self._counts = dict.fromkeys(FrameOutcome, 0)
        self._dropped, self._diagnosed = 0, -DIAGNOSTICS_PERIOD
        self._painter = TrackPainter()
        self._outcome: FrameOutcome | None = None
        self._participant = Participant(self, lambda _: self._work(), every=TICK_STEPS)
        self._state = self._participant.publisher(VioState, "vio/state")
        self._odometry = self._participant.publisher(Odometry, "vio/odometry")
        self._debug = self.create_publisher(Image, "vio/debug_image", qos.IMAGE)
        self._imu = self.create_backlog(Imu, "imu/data_raw", qos.CHAIN)
        self.create_subscription(Image, f"camera_{self.params.camera}/image_raw", self._receive_image, qos.IMAGE)
        self.create_timer(LOOK, self._work, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._participant.greet()

    def _receive_image(self, msg: Image) -> None:
        self._waiting.append(msg)
        while self._participant.lockstep is False and len(self._waiting) > QUEUE:
            self._dropped += 1
            self._participant.report(self._waiting.popleft().header.stamp)
        self._work()

    def _work(self) -> None:
        """Take the IMU's samples, and use every waiting frame whose exposure they have passed."""
        for data in self._imu.take():
            self._vio.add_imu(ImuSample(*read_imu(data)))
        while self._waiting and self._vio.covers(nanoseconds(self._waiting[0].header.stamp)):
            msg = self._waiting.popleft()
            try:
                self._use(msg)
            finally:
                self._participant.report(msg.header.stamp)  # the vehicle waits for this, whatever happened

    def _use(self, msg: Image) -> None:
        begin, stamp = time.perf_counter(), nanoseconds(msg.header.stamp)
        try:
            image = mono_image(msg, self._mount.camera)
        except ImageError as error:
            image, result = None, VioResult(FrameOutcome.BAD_IMAGE, message=str(error))
        else:
            # the tracker keeps the frame: a view into the message would change with the next one
            result = self._vio.add_image(stamp, np.array(image))
        self._costs.append(time.perf_counter() - begin)
        self._counts[result.outcome] += 1
        if result.estimate is not None:
            self._publish(result)
        if result.outcome is not self._outcome:
            text = f"{result.outcome.name.lower()}: {result.message}"
            # rclpy refuses one call site with two severities
            if result.outcome.has_pose:
                self.get_logger().info(text)
            else:
                self.get_logger().warning(text)
            self._outcome = result.outcome
        if image is not None and self._debug.get_subscription_count():
            self._publish_debug(msg, image, result)
        if stamp - self._diagnosed >= DIAGNOSTICS_PERIOD:
            self._diagnosed = stamp
            self._publish_diagnostics(stamp, result)

    def _publish(self, result: VioResult) -> None:
        e = result.estimate
        header, q_WB = Header(stamp=to_stamp(e.stamp), frame_id="odom"), so3.quat_from_matrix(e.R_WB)
        self._state.publish(VioState(
            header=header, position=to_point(e.p_WB), orientation=to_quaternion(q_WB), velocity=to_vector(e.v_WB),
            gyro_bias=to_vector(e.gyro_bias), accel_bias=to_vector(e.accel_bias), covariance=e.P.ravel()))
        msg = Odometry(header=header, child_frame_id="base_link")
        fill_odometry(msg, e.p_WB, q_WB, e.v_WB, e.w_WB_B)
        pose, twist = covariances(e.R_WB, e.v_WB, e.P, self.params.imu.gyro_noise)
        msg.pose.covariance, msg.twist.covariance = pose.ravel(), twist.ravel()
        self._odometry.publish(msg)

    def _publish_debug(self, source: Image, image: np.ndarray, result: VioResult) -> None:
        landmarks = set(self._vio.filter.state.landmarks) if self._vio.filter else set()
        caption = f"{result.outcome.name.lower()}  {result.features} tracks, {result.used} used, {result.refused} refused"
        features = self._vio.tracker.latest
        if features is None:
            return
        drawn = self._painter.paint(image, features, landmarks, caption)
        msg = Image(header=source.header, height=drawn.shape[0], width=drawn.shape[1], encoding="bgr8",
                    step=3 * drawn.shape[1])
        msg.data = drawn.tobytes()
        self._debug.publish(msg)

    def _publish_diagnostics(self, stamp: int, result: VioResult) -> None:
        costs = 1e3 * np.array(self._costs)
        values: dict[str, Any] = {
            "outcome": result.outcome.name, "features": result.features, "used": result.used, "refused": result.refused,
            "blind_for_s": float(result.blind_for), "restarts": result.restarts, "dropped": self._dropped,
            "time_offset_ms": 1e3 * float(self._vio.time_offset),
            "cost_ms_median": float(np.median(costs)), "cost_ms_p99": float(np.percentile(costs, 99))}
        values |= {f"frames_{outcome.name.lower()}": n for outcome, n in self._counts.items() if n}
        self.publish_diagnostics(stamp * 1e-9, values, 0 if result.outcome.has_pose else 1, result.message)


def create(**kwargs: Any) -> VioNode:
    """The node, for its own process or a composed one."""
    return VioNode(**kwargs)


def main() -> None:
    """Entry point of the executable `vio`."""
    spin_main(create)
