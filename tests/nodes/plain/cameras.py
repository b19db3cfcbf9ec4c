"""A camera over a textured floor and one at a board of four AprilTags, both at rest, from plain publishers: nothing of perch is
imported. `cameras.py raw|compressed|both` prints what came back as JSON. Nobody but the nodes themselves says where the vehicle is."""

import array
import json
import sys
import time

import cv2
import numpy as np
import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, Imu

WIDTH, HEIGHT, FOCAL, DISTANCE = 640, 480, 400.0, 1.5
TAGS = {0: (-0.2, 0.2), 1: (0.2, 0.2), 2: (0.2, -0.2), 3: (-0.2, -0.2)}  # centres on the board, x right, y up [m]


def board(size: float) -> np.ndarray:
    """The pad of config/boards/pad_four_tags.yaml as a pinhole camera in front of its middle sees it."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    image, scale = np.full((HEIGHT, WIDTH), 200, np.uint8), FOCAL / DISTANCE
    side = round(size * scale)
    for number, (x, y) in TAGS.items():
        tag = cv2.aruco.generateImageMarker(dictionary, number, side)
        u, v = round(WIDTH / 2 + x * scale - side / 2), round(HEIGHT / 2 - y * scale - side / 2)
        image[v:v + side, u:u + side] = tag
    return cv2.GaussianBlur(image, (0, 0), 0.7)


class Cameras(Node):
    def __init__(self, kinds: str) -> None:
        super().__init__("plain_cameras")
        rng = np.random.default_rng(1)
        floor = cv2.GaussianBlur(rng.integers(0, 255, (HEIGHT, WIDTH)).astype(np.uint8), (0, 0), 2.0)
        self.images = {"down": cv2.normalize(floor, None, 0, 255, cv2.NORM_MINMAX), "front": board(0.16)}
        self.ticks = 0
        self.stamp = time.time_ns() + {"raw": 10, "both": 20, "compressed": 30}[kinds] * 10**9  # evidently another stream than that of the script before
        topics = {Image: "image_raw", CompressedImage: "image_raw/compressed"}
        wanted = {"raw": [Image], "both": [CompressedImage, Image], "compressed": [CompressedImage]}[kinds]
        self.cameras = {name: ([(kind, self.create_publisher(kind, f"camera_{name}/{topics[kind]}", qos_profile_sensor_data)) for kind in wanted],
                               self.create_publisher(CameraInfo, f"camera_{name}/camera_info", qos_profile_sensor_data)) for name in self.images}
        self.imu = self.create_publisher(Imu, "imu/data_raw", qos_profile_sensor_data)
        self.poses, self.targets = [], []
        self.create_subscription(Odometry, "vio/odometry", lambda m: self.poses.append(self.place(m.pose.pose)), qos_profile_sensor_data)
        self.create_subscription(PoseWithCovarianceStamped, "target/pose", lambda m: self.targets.append(self.place(m.pose.pose)), 10)
        self.create_timer(0.005, self.step)

    @staticmethod
    def place(pose) -> list:
        return [pose.position.x, pose.position.y, pose.position.z]

    def step(self) -> None:
        imu = Imu()
        self.stamp += 5_000_000
        imu.header.stamp.sec, imu.header.stamp.nanosec = divmod(self.stamp, 10**9)
        imu.header.frame_id, imu.linear_acceleration.z = "imu_link", 9.81
        self.imu.publish(imu)
        self.ticks += 1
        if self.ticks % 7 == 0:
            for name in self.images:
                self.show(name, imu.header.stamp)

    def show(self, name: str, now) -> None:
        pixels, (images, infos) = self.images[name], self.cameras[name]
        info = CameraInfo(height=HEIGHT, width=WIDTH, distortion_model="plumb_bob", d=[0.0] * 5)
        info.k = np.array([FOCAL, 0.0, WIDTH / 2 - 0.5, 0.0, FOCAL, HEIGHT / 2 - 0.5, 0.0, 0.0, 1.0])
        info.header.stamp, info.header.frame_id = now, f"camera_{name}_optical_frame"
        infos.publish(info)
        for kind, publisher in images:
            if kind is CompressedImage:
                image = kind(format="png", data=array.array("B", cv2.imencode(".png", pixels)[1].tobytes()))
            else:
                image = kind(height=HEIGHT, width=WIDTH, encoding="8UC1", step=WIDTH, data=array.array("B", pixels.tobytes()))  # of bytes, ROS would check each
            image.header = info.header
            publisher.publish(image)


rclpy.init()
node = Cameras(sys.argv[1])
end = time.monotonic() + 250.0
while (len(node.poses) < 20 or len(node.targets) < 5) and time.monotonic() < end:
    rclpy.spin_once(node, timeout_sec=0.1)
print(json.dumps({"poses": node.poses, "targets": node.targets}))
