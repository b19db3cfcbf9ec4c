"""The vehicle's publishers, and its state written into messages."""

from __future__ import annotations

import array
from collections.abc import Mapping

import numpy as np
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from perch_msgs.msg import Contact, RotorState
from rclpy.node import Node
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, Image, Imu

from perch_core import so3
from perch_core.camera import CameraMount
from perch_core.ros import qos
from perch_core.ros.composition import composition
from perch_core.ros.conversions import to_pose, to_stamp
from perch_core.ros.wire import CameraInfoTemplate, ImuTemplate, OdometryTemplate
from perch_core.surface import PerchSurface
from perch_core.vehicle import ImuConfig
from perch_sim.contact_event import ContactEvent
from perch_sim.imu import ImuSample
from perch_sim.state_history import TrueState


class CameraTopics:
    """`image_raw` and `camera_info` of one camera; both carry the frame's stamp."""

    def __init__(self, node: Node, mount: CameraMount) -> None:
        prefix = f"camera_{mount.name}"
        camera = mount.camera
        self.image = node.create_publisher(Image, f"{prefix}/image_raw", qos.IMAGE)
        self.info = node.create_publisher(CameraInfo, f"{prefix}/camera_info", qos.CHAIN)
        frame_id = f"{prefix}_optical_frame"
        channels = 3 if mount.colour else 1
        self._image = Image(height=camera.height, width=camera.width, encoding="rgb8" if mount.colour else "mono8",
                            step=camera.width * channels)
        self._image.data = array.array("B", bytes(camera.height * camera.width * channels))
        self._pixels = np.frombuffer(self._image.data, np.uint8)  # a view: assigning whole images takes 18 ms
        self._image.header.frame_id = frame_id
        info = CameraInfo(height=camera.height, width=camera.width, distortion_model=camera.model)
        info.d = [float(k) for k in camera.distortion]
        info.k = camera.K.ravel()
        info.r = np.eye(3).ravel()
        info.p = np.hstack([camera.K, np.zeros((3, 1))]).ravel()
        info.header.frame_id = frame_id
        self._info = CameraInfoTemplate(info)

    def publish(self, stamp: int, pixels: np.ndarray | None) -> None:
        """A frame: its camera_info, and its image where one was taken."""
        self.info.publish(self._info.fill(stamp))
        if pixels is not None:
            self._image.header.stamp = to_stamp(stamp)
            np.copyto(self._pixels, pixels.ravel())
            self.image.publish(self._image)


class VehicleTopics:
    """Everything but `step` that the vehicle publishes."""

    def __init__(self, node: Node, imu: ImuConfig, mounts: Mapping[str, CameraMount]) -> None:
        self.imu = composition.publisher(node, Imu, "imu/data_raw", qos.CHAIN)
        self.odometry = composition.publisher(node, Odometry, "ground_truth/odometry", qos.CHAIN, urgent=False)
        self.target = node.create_publisher(PoseStamped, "ground_truth/target", qos.LATCHED)
        self.rotors = node.create_publisher(RotorState, "rotor_state", qos.CHAIN)
        self.contact = node.create_publisher(Contact, "contact", qos.GATED)
        self.clock = node.create_publisher(Clock, "/clock", qos.STATUS)
        self.cameras = {name: CameraTopics(node, mount) for name, mount in mounts.items()}
        sample, truth, self._rotors = Imu(), Odometry(child_frame_id="base_link"), RotorState()
        sample.header.frame_id = "imu_link"
        sample.orientation_covariance[0] = -1.0  # sensor_msgs: no orientation
        sample.angular_velocity_covariance = (np.eye(3) * imu.gyro_noise**2).ravel()
        sample.linear_acceleration_covariance = (np.eye(3) * imu.accel_noise**2).ravel()
        truth.header.frame_id, self._rotors.header.frame_id = "map", "base_link"
        self._imu, self._odometry = ImuTemplate(sample), OdometryTemplate(truth)

    def publishers(self) -> list:
        """All of them, to see who listens."""
        return [self.imu, self.odometry, self.target, self.rotors, self.contact,
                *(p for camera in self.cameras.values() for p in (camera.image, camera.info))]

    def publish_clock(self, time: int) -> None:
        """Simulation time [ns] on /clock, where somebody listens."""
        if not composition.heard_outside(self.clock):
            return
        self.clock.publish(Clock(clock=to_stamp(time)))

    def publish_imu(self, time: int, sample: ImuSample) -> None:
        """One IMU sample."""
        self.imu.publish(self._imu.fill(time, sample.gyro.tolist(), sample.accel.tolist()))

    def publish_truth(self, state: TrueState) -> None:
        """The true state, where somebody listens."""
        if not self.odometry.heard:
            return
        x = state.x.tolist()
        self.odometry.publish(self._odometry.fill(state.time, x[0:3], x[3:7], x[7:10], x[10:13]))

    def publish_rotors(self, time: int, speed: np.ndarray, thrust: np.ndarray) -> None:
        """Rotor speeds [rad/s] and thrusts [N], (4,), where somebody listens."""
        if not composition.heard_outside(self.rotors):
            return
        self._rotors.header.stamp = to_stamp(time)
        self._rotors.rotor_speed, self._rotors.thrust = speed, thrust
        self.rotors.publish(self._rotors)

    def publish_contact(self, event: ContactEvent) -> None:
        """A change of what the vehicle touches."""
        msg = Contact(state=int(event.state), body=event.body, normal_speed=float(event.normal_speed),
                      tangential_speed=float(event.tangential_speed), tilt_error=float(event.tilt_error),
                      offset=float(event.offset), reason=event.reason)
        msg.header.stamp, msg.header.frame_id = to_stamp(float(event.time)), "map"
        self.contact.publish(msg)

    def publish_target(self, time: int, pad: PerchSurface) -> None:
        """The true pose of the pad's frame S."""
        msg = PoseStamped(pose=to_pose(pad.p_WS, so3.quat_from_matrix(pad.R_WS)))
        msg.header.stamp, msg.header.frame_id = to_stamp(time), "map"
        self.target.publish(msg)
