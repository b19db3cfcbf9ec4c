"""Node `vio` as a slow participant: one report per image whatever it is, odometry at the exposure's time, debug image."""

import time

import numpy as np
import pytest
import rclpy
from nav_msgs.msg import Odometry
from perch_core.errors import ConfigError
from perch_core.ros import qos
from perch_core.ros.conversions import nanoseconds, odometry_arrays, to_stamp
from perch_msgs.msg import StepReport
from perch_perception import vio_node
from rclpy.experimental import EventsExecutor
from rclpy.parameter import Parameter
from sensor_msgs.msg import Image, Imu

MS = 1_000_000
SECOND = 1000 * MS


class Vehicle:
    """IMU at rest and images of a blank floor, as before take-off."""

    def __init__(self, context, executor):
        self.node = rclpy.create_node("test_vehicle", context=context)
        executor.add_node(self.node)
        self.executor, self.time = executor, SECOND
        self.rng = np.random.default_rng(1)
        self.odometry, self.reports = [], []
        self.imu_publisher = self.node.create_publisher(Imu, "imu/data_raw", qos.CHAIN)
        self.image_publisher = self.node.create_publisher(Image, "camera_down/image_raw", qos.IMAGE)
        self.node.create_subscription(Odometry, "vio/odometry", self.odometry.append, qos.GATED)
        self.node.create_subscription(StepReport, "step_report", self.reports.append, qos.GATED)

    def spin_until(self, condition, what):
        for _ in range(1500):
            if condition():
                return
            self.executor.spin_once(timeout_sec=0.01)
        raise AssertionError(f"never saw {what}")

    def run_imu(self, until):
        while self.time < until:
            self.time += 2 * MS
            msg = Imu()
            msg.header.stamp = to_stamp(self.time)
            w, f = self.rng.normal(0, 0.01, 3), self.rng.normal(0, 0.3, 3) + [0, 0, 9.81]
            msg.angular_velocity.x, msg.angular_velocity.y, msg.angular_velocity.z = map(float, w)
            msg.linear_acceleration.x, msg.linear_acceleration.y, msg.linear_acceleration.z = map(float, f)
            self.imu_publisher.publish(msg)
            if self.time % (100 * MS) == 0:  # the node has no ticks here: before its queue is full, let it look by itself
                end = time.monotonic() + 2.0 * vio_node.LOOK
                while time.monotonic() < end:
                    self.executor.spin_once(timeout_sec=0.005)

    def image(self, stamp, **changes):
        pixels = np.clip(self.rng.normal(110, 4, (480, 640)), 0, 255).astype(np.uint8)
        msg = Image(height=480, width=640, encoding="mono8", step=640)
        msg.data = pixels.tobytes()
        msg.header.stamp = to_stamp(stamp)
        for name, value in changes.items():
            setattr(msg, name, value)
        self.image_publisher.publish(msg)

    def frame(self, stamp, **changes):
        """An image with the IMU samples after it, and the report that answers it."""
        self.run_imu(stamp + 20 * MS)
        before = self.reported(stamp)
        self.image(stamp, **changes)
        self.spin_until(lambda: self.reported(stamp) > before, f"the report of image {stamp}")

    def reported(self, stamp):
        return sum(nanoseconds(r.trigger) == stamp for r in self.reports)


@pytest.fixture
def vehicle(ros_domain):
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=ros_domain)
    executor = EventsExecutor(context=context)
    node = vio_node.create(context=context, parameter_overrides=[
        Parameter("start_position", value=[1.0, 2.0, 0.0]), Parameter("start_yaw_deg", value=90.0)])
    executor.add_node(node)
    driver = Vehicle(context, executor)
    driver.spin_until(lambda: driver.imu_publisher.get_subscription_count() > 0
                      and driver.image_publisher.get_subscription_count() > 0 and driver.reports, "the node's greeting")
    yield driver
    driver.node.destroy_node()
    node.destroy_node()
    rclpy.shutdown(context=context)


def test_greets_with_its_gated_topic(vehicle):
    greeting = vehicle.reports[0]
    assert greeting.node == "vio" and nanoseconds(greeting.trigger) == 0
    assert [(r.topic, r.count) for r in greeting.published] == [("/vio/state", 0), ("/vio/odometry", 0)]


def test_stands_where_it_was_told_at_the_exposures_time(vehicle):
    stamps = [SECOND + 300 * MS + k * 33 * MS for k in range(5)]
    for stamp in stamps:
        vehicle.frame(stamp)
    vehicle.spin_until(lambda: len(vehicle.odometry) == 5, "five poses")
    last = vehicle.odometry[-1]
    assert (last.header.frame_id, last.child_frame_id) == ("odom", "base_link")
    # the vehicle's file: the stamp is 8 ms before the middle of the exposure
    assert nanoseconds(last.header.stamp) == stamps[-1] + 8 * MS
    p, q, v, _ = odometry_arrays(last)
    np.testing.assert_allclose(p, [1.0, 2.0, 0.04], atol=2e-3)
    assert np.degrees(2 * np.arctan2(q[2], q[3])) == pytest.approx(90.0, abs=0.5)
    np.testing.assert_allclose(v, 0.0, atol=0.02)
    covariance = np.array(last.pose.covariance).reshape(6, 6)
    assert np.linalg.eigvalsh(covariance)[0] > 0 and covariance[0, 0] < 1e-4
    counts = [r.published[0].count for r in vehicle.reports if nanoseconds(r.trigger)]
    assert counts == [1, 2, 3, 4, 5]


@pytest.mark.parametrize("changes", [
    dict(encoding="32FC1"), dict(width=320), dict(data=b"\x00" * 100), dict(height=0, step=0, data=b""),
])
def test_an_unusable_image_is_reported_without_a_pose(vehicle, changes):
    vehicle.frame(SECOND + 300 * MS)
    vehicle.frame(SECOND + 333 * MS, **changes)
    vehicle.frame(SECOND + 366 * MS)
    vehicle.spin_until(lambda: len(vehicle.odometry) == 2, "two poses")
    assert [nanoseconds(m.header.stamp) for m in vehicle.odometry] == [SECOND + 308 * MS, SECOND + 374 * MS]


def test_duplicate_old_and_future_stamps_are_reported_and_the_next_frame_works(vehicle):
    vehicle.frame(SECOND + 300 * MS)
    vehicle.frame(SECOND + 300 * MS)         # duplicate
    vehicle.frame(SECOND + 100 * MS)         # out of order
    vehicle.image(SECOND + 20_000 * MS)      # 20 s ahead: cannot be waited for
    vehicle.run_imu(vehicle.time + 4 * MS)
    vehicle.spin_until(lambda: vehicle.reported(SECOND + 20_000 * MS) == 1, "the report of the future image")
    vehicle.frame(SECOND + 366 * MS)
    vehicle.spin_until(lambda: len(vehicle.odometry) == 2, "two poses")
    assert vehicle.reported(SECOND + 300 * MS) == 2


def test_an_image_waits_for_the_imu(vehicle):
    vehicle.run_imu(SECOND + 300 * MS)
    vehicle.image(SECOND + 320 * MS)
    for _ in range(20):
        vehicle.executor.spin_once(timeout_sec=0.01)
    assert vehicle.reported(SECOND + 320 * MS) == 0
    vehicle.run_imu(SECOND + 340 * MS)
    vehicle.spin_until(lambda: vehicle.reported(SECOND + 320 * MS) == 1, "the report after the IMU came")


def test_debug_image_for_those_who_watch(vehicle):
    seen = []
    vehicle.node.create_subscription(Image, "vio/debug_image", seen.append, qos.IMAGE)
    for k in range(30):
        vehicle.frame(SECOND + 300 * MS + k * 33 * MS)
        if seen:
            break
    vehicle.spin_until(lambda: seen, "a debug image")
    assert (seen[0].width, seen[0].height, seen[0].encoding) == (640, 480, "bgr8")
    assert len(seen[0].data) == 640 * 480 * 3


def test_an_unknown_camera_is_refused_by_name(ros_domain):
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=ros_domain)
    try:
        with pytest.raises(ConfigError, match=r"camera.*rear.*down, front"):
            vio_node.create(context=context, parameter_overrides=[Parameter("camera", value="rear")])
    finally:
        rclpy.shutdown(context=context)
