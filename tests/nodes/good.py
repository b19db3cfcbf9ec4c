"""A good message of every topic that a node takes, and a good request of every service."""

from __future__ import annotations

import array
import math
from typing import Any

import numpy as np
from geometry_msgs.msg import Point, PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import Odometry
from perch_msgs.msg import (
    ControllerCommand, ControllerStatus, EstimatorStatus, PolynomialSegment, Powerline, PowerlineArray, Trajectory, TrajectoryPoint, VioState)
from perch_msgs.srv import PlanPerch, PlanPowerline, SetController
from sensor_msgs.msg import CameraInfo, Image, Imu
from tf2_msgs.msg import TFMessage

WIDTH, HEIGHT = 640, 480


def messages(stamp: int) -> dict[str, Any]:
    """Topic -> message of a stamp [ns]."""
    samples = Trajectory(points=[TrajectoryPoint(time_from_start=0.1 * i) for i in range(3)], recovery_start=-1.0)
    for point in samples.points:
        point.pose.orientation.w, point.pose.position.z, point.rotor_thrust = 1.0, 1.0, np.full(4, 1.2)
    constant = [0.0] * 6
    found = {
        "imu/data_raw": _imu(), "vio/odometry": _odometry("odom"), "vio/state": _vio_state(), "odometry": _odometry("map"),
        "estimator/status": EstimatorStatus(state=1), "controller/status": ControllerStatus(state=1, controller="geometric"),
        "target/pose": _target(), "powerlines": PowerlineArray(lines=[_powerline()]),
        "trajectory": Trajectory(segments=[PolynomialSegment(duration=2.0, x=constant, y=constant, z=[1.0] * 6, yaw=constant)], recovery_start=-1.0),
        "recovery": samples, "controller/command": ControllerCommand(command=ControllerCommand.HOVER),
    }
    for camera in ("down", "front"):
        frame = f"camera_{camera}_optical_frame"
        found[f"camera_{camera}/camera_info"] = _camera_info(frame)
        found[f"camera_{camera}/image_raw"] = _image(frame)
    for message in found.values():
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 10**9)
        message.header.frame_id = message.header.frame_id or "map"
    place = TransformStamped(child_frame_id="imu_link")
    place.header.frame_id, place.transform.rotation.w = "base_link", 1.0
    return found | {"/tf_static": TFMessage(transforms=[place])}


def requests() -> dict[str, tuple[type, Any]]:
    """Service -> type and request: a perch on a wall 1.7 m away, one on a wire, another law."""
    nan = math.nan
    wall = PlanPerch.Request(impact_acceleration=nan, impact_speed_min=nan, impact_speed_max=nan, thrust_max=nan, thrust_min=nan)
    wall.start_position.z, wall.target.position.x, wall.target.position.z = 1.2, 1.7, 1.2
    wall.target.orientation.y, wall.target.orientation.w = -math.sqrt(0.5), math.sqrt(0.5)
    wire = _powerline()
    wire.start.z = wire.end.z = 4.7
    line = PlanPowerline.Request(lines=[wire], perch_point=Point(x=4.0, z=4.7), perch_pitch=math.radians(20.0), deadline=10.0)
    line.start_pose.position.z, line.start_pose.orientation.w = 4.3, 1.0
    law = SetController.Request(type="geometric")
    return {"plan_perch": (PlanPerch, wall), "plan_powerline": (PlanPowerline, line), "set_controller": (SetController, law)}


def _imu() -> Imu:
    message = Imu()
    message.header.frame_id, message.linear_acceleration.z = "imu_link", 9.81
    return message


def _odometry(frame: str) -> Odometry:
    message = Odometry(child_frame_id="base_link")
    message.header.frame_id, message.pose.pose.orientation.w = frame, 1.0
    for i in range(6):
        message.pose.covariance[7 * i], message.twist.covariance[7 * i] = 1e-4, 1e-3
    return message


def _vio_state() -> VioState:
    message = VioState(covariance=(1e-4 * np.eye(15)).ravel())
    message.header.frame_id, message.orientation.w = "odom", 1.0
    return message


def _target() -> PoseWithCovarianceStamped:
    message = PoseWithCovarianceStamped()
    message.pose.pose.orientation.w = 1.0
    message.pose.covariance = (1e-4 * np.eye(6)).ravel()
    return message


def _powerline() -> Powerline:
    message = Powerline(radius=0.01, covariance=(1e-4 * np.eye(3)).ravel(), direction_sigma=0.01)
    message.start.x = message.end.x = 4.0
    message.start.y, message.end.y = -2.0, 2.0
    return message


def _camera_info(frame: str) -> CameraInfo:
    message = CameraInfo(height=HEIGHT, width=WIDTH, distortion_model="plumb_bob", d=[0.0] * 5)
    message.k = np.array([400.0, 0.0, WIDTH / 2, 0.0, 400.0, HEIGHT / 2, 0.0, 0.0, 1.0])
    message.header.frame_id = frame
    return message


def _image(frame: str) -> Image:
    message = Image(height=HEIGHT, width=WIDTH, encoding="mono8", step=WIDTH)
    message.data = array.array("B", bytes(WIDTH * HEIGHT))  # of bytes, ROS would check each
    message.header.frame_id = frame
    return message
