"""A camera that climbs past a red wire, from plain publishers: nothing of perch is imported but messages. Prints the map as JSON.

The camera is that of config/vehicles/rpg.yaml: 9 cm below the centre, looking ahead; the wire is level, across, 4 m ahead, at 1.5 m.
"""

import array
import json
import time

import cv2
import numpy as np
import rclpy
from nav_msgs.msg import Odometry
from perch_msgs.msg import PowerlineArray
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, Image

WIDTH, HEIGHT, FOCAL, DISTANCE, WIRE, RADIUS, BELOW = 640, 480, 385.0, 4.0, 1.5, 0.03, 0.09
SIGMA = 0.08  # with which the wire is known in every direction when the map is taken [m]


class Climb(Node):
    def __init__(self) -> None:
        super().__init__("plain_wires")
        self.images = self.create_publisher(Image, "camera_front/image_raw", qos_profile_sensor_data)
        self.infos = self.create_publisher(CameraInfo, "camera_front/camera_info", qos_profile_sensor_data)
        self.odometry = self.create_publisher(Odometry, "odometry", qos_profile_sensor_data)
        self.lines, self.sigma, self.stamp, self.ticks = [], np.inf, time.time_ns(), 0
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.create_subscription(PowerlineArray, "powerlines", self.take, latched)
        self.create_timer(0.02, self.step)

    def take(self, msg) -> None:
        self.lines = [[[line.start.x, line.start.y, line.start.z], [line.end.x, line.end.y, line.end.z]] for line in msg.lines]
        self.sigma = max((line.covariance[4 * i] ** 0.5 for line in msg.lines for i in range(3)), default=np.inf)

    def step(self) -> None:
        self.stamp, self.ticks = self.stamp + 20_000_000, self.ticks + 1
        height = 1.0 + 0.8 * (0.5 - 0.5 * np.cos(0.03 * self.ticks))
        state = Odometry()
        state.header.stamp.sec, state.header.stamp.nanosec = divmod(self.stamp, 10**9)
        state.header.frame_id, state.child_frame_id = "map", "base_link"
        state.pose.pose.position.z, state.pose.pose.orientation.w = float(height), 1.0
        state.twist.twist.linear.z = float(0.8 * 0.5 * 0.03 / 0.02 * np.sin(0.03 * self.ticks))
        for i in range(6):
            state.pose.covariance[7 * i] = 1e-6
        self.odometry.publish(state)
        if self.ticks % 5 == 0:
            self.show(state.header.stamp, height)

    def show(self, stamp, height: float) -> None:
        row = HEIGHT / 2 - FOCAL * (WIRE - (height - BELOW)) / DISTANCE
        covered = np.clip(RADIUS * FOCAL / DISTANCE + 0.5 - np.abs(np.arange(HEIGHT) - row), 0.0, 1.0)
        pixels = np.full((HEIGHT, WIDTH, 3), 120.0)
        pixels += covered[:, None, None] * (np.array([200.0, 30.0, 30.0]) - 120.0)
        image = Image(height=HEIGHT, width=WIDTH, encoding="rgb8", step=3 * WIDTH)
        image.data = array.array("B", cv2.GaussianBlur(pixels, (0, 0), 0.8).astype(np.uint8).tobytes())  # of bytes, ROS would check each
        info = CameraInfo(height=HEIGHT, width=WIDTH, distortion_model="plumb_bob", d=[0.0] * 5)
        info.k = np.array([FOCAL, 0.0, WIDTH / 2, 0.0, FOCAL, HEIGHT / 2, 0.0, 0.0, 1.0])
        image.header.stamp = info.header.stamp = stamp
        image.header.frame_id = info.header.frame_id = "camera_front_optical_frame"
        self.infos.publish(info), self.images.publish(image)


rclpy.init()
node, end = Climb(), time.monotonic() + 250.0
while node.sigma > SIGMA and time.monotonic() < end:
    rclpy.spin_once(node, timeout_sec=0.1)
print(json.dumps({"lines": node.lines}))
