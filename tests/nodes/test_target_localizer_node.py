"""Node `target_localizer` in a lockstep played by the test: one answer and one report per image, whatever it holds."""

import numpy as np
import pytest
import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from perch_core import so3
from perch_core.errors import ConfigError
from perch_core.ros import qos
from perch_core.ros.conversions import fill_odometry, nanoseconds, pose_arrays, to_seconds, to_stamp
from perch_core.scenario import load_scenario
from perch_core.vehicle import load_vehicle
from perch_msgs.msg import Step, StepReport, TargetDetection
from perch_perception import target_localizer_node
from perch_sim.rendering import Renderer, build_scene
from rclpy.experimental import EventsExecutor
from rclpy.parameter import Parameter
from sensor_msgs.msg import Image

STEP_NS = 2_000_000
MOUNT = load_vehicle("snapdragon").mounts["front"]
SCENARIO = load_scenario("surface_60")
SPEED = 1.5  # towards the pad [m/s]


def position(t):
    return np.array([SPEED * t, 0.0, 1.2])


@pytest.fixture(scope="module")
def renderer():
    return Renderer(build_scene(SCENARIO, seed=2), MOUNT, seed=2)


class Vehicle:
    """The test's side: it flies towards the pad and sends odometry, steps and images."""

    def __init__(self, context, executor, renderer):
        self.node = rclpy.create_node("test_vehicle", context=context)
        executor.add_node(self.node)
        self.executor, self.renderer, self.index = executor, renderer, 0
        self.rng = np.random.default_rng(0)
        self.detections, self.reports, self.poses = [], [], []
        self.odometry = self.node.create_publisher(Odometry, "odometry", qos.CHAIN)
        self.ticks = self.node.create_publisher(Step, "tick", qos.STEP)
        self.images = self.node.create_publisher(Image, "camera_front/image_raw", qos.IMAGE)
        self.node.create_subscription(TargetDetection, "target/detections", self.detections.append, qos.GATED)
        self.node.create_subscription(StepReport, "step_report", self.reports.append, qos.GATED)
        self.node.create_subscription(PoseWithCovarianceStamped, "target/pose", self.poses.append, qos.GATED)

    def spin_until(self, condition, what):
        for _ in range(1000):
            if condition():
                return
            self.executor.spin_once(timeout_sec=0.01)
        raise AssertionError(f"never saw {what}")

    def advance(self, until):
        """Steps with odometry up to a time [s]."""
        while self.index * STEP_NS < round(until * 1e9):
            stamp = to_stamp(self.index * STEP_NS)
            msg = Odometry()
            msg.header.stamp = stamp
            fill_odometry(msg, position(to_seconds(stamp)), np.array([0.0, 0.0, 0.0, 1.0]),
                          np.array([SPEED, 0.0, 0.0]), np.zeros(3))
            msg.pose.covariance = np.diag([1e-4] * 3 + [1e-5] * 3).ravel()
            self.odometry.publish(msg)
            self.ticks.publish(Step(stamp=stamp, index=self.index, lockstep=True))
            self.index += 1

    def send(self, exposed, pixels=None, **fields):
        """An image exposed at a true time [s]; its stamp carries the camera's offset."""
        if pixels is None:
            pixels = self.renderer.render([(position(exposed), np.eye(3))], self.rng)
        msg = Image(height=480, width=640, step=640, encoding="mono8")
        msg.data = pixels.tobytes()
        msg.header.stamp = to_stamp(round((exposed + MOUNT.stamp_offset) * 1e9))
        for name, value in fields.items():
            setattr(msg, name, value)
        self.images.publish(msg)
        return nanoseconds(msg.header.stamp)

    def answer(self, count):
        self.spin_until(lambda: len(self.detections) >= count and self.answered() >= count, f"answer {count}")
        return self.detections[count - 1]

    def answered(self):
        return len([r for r in self.reports if nanoseconds(r.trigger) > 0])


@pytest.fixture
def graph(ros_domain, renderer):
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=ros_domain)
    executor = EventsExecutor(context=context)
    nodes = []

    def start(**parameters):
        node = target_localizer_node.create(
            context=context, parameter_overrides=[Parameter(k, value=v) for k, v in parameters.items()])
        executor.add_node(node)
        nodes.append(node)
        vehicle = Vehicle(context, executor, renderer)
        nodes.append(vehicle.node)
        vehicle.spin_until(lambda: vehicle.reports, "the greeting")
        vehicle.spin_until(lambda: vehicle.images.get_subscription_count() > 0
                           and vehicle.odometry.get_subscription_count() > 0
                           and vehicle.ticks.get_subscription_count() > 0, "the node's subscriptions")
        return vehicle

    yield start
    for node in nodes:
        node.destroy_node()
    rclpy.shutdown(context=context)


def target_error(pose):
    p, q = pose_arrays(pose)
    turn = so3.log(so3.quat_to_matrix(q).T @ SCENARIO.surface.R_WS)
    return np.linalg.norm(p - SCENARIO.surface.p_WS), np.degrees(np.linalg.norm(turn))


def test_greets_with_its_gated_topics(graph):
    vehicle = graph()
    assert {r.topic for r in vehicle.reports[0].published} == {"/target/detections", "/target/pose"}
    assert vehicle.reports[0].node == "target_localizer"


def test_uses_the_pose_of_the_exposure_not_of_the_arrival(graph):
    """At 1.5 m/s the vehicle moves 7 cm until the image is handled; the target must not move with it."""
    vehicle = graph()
    stamp = vehicle.send(0.100)
    vehicle.advance(0.150)
    detection = vehicle.answer(1)
    assert detection.found and detection.method == "joint" and list(detection.ids) == [0, 1, 2, 3]
    assert (detection.header.frame_id, to_seconds(detection.header.stamp)) == ("map", pytest.approx(0.100, abs=1e-6))
    distance, degrees = target_error(detection.pose.pose)
    assert distance < 0.01 and degrees < 0.5
    covariance = np.array(detection.pose.covariance).reshape(6, 6)
    assert np.linalg.eigvalsh(covariance)[0] > 0 and covariance[0, 0] >= 1e-4
    assert vehicle.poses[0].pose.pose == detection.pose.pose
    last = vehicle.reports[-1]
    assert nanoseconds(last.trigger) == stamp
    assert {r.topic: r.count for r in last.published} == {"/target/detections": 1, "/target/pose": 1}


def test_every_image_is_answered_whatever_it_holds(graph):
    vehicle = graph()
    blank = np.full((480, 640), 40, np.uint8)
    for k, (exposed, pixels, fields) in enumerate([
            (0.100, None, {}),
            (0.100, None, {}),                             # the same stamp again
            (0.150, blank, {}),                            # nothing to see
            (0.200, None, {"encoding": "16UC1"}),          # not an image we can read
            (9.0, None, {})]):                             # from the future
        vehicle.send(exposed, pixels, **fields)
        vehicle.advance(0.11 + 0.05 * k)
        vehicle.answer(k + 1)
    assert [d.found for d in vehicle.detections] == [True, False, False, False, False]
    for detection, why in zip(vehicle.detections[1:], ("not newer", "no tag", "16UC1", "ahead of the odometry")):
        assert why in detection.message
    vehicle.send(0.350)
    vehicle.advance(0.4)
    assert vehicle.answer(6).found, "one stamp from the future must not block what follows"


def test_without_odometry_at_the_stamp_there_is_no_pose_in_map(graph):
    vehicle = graph()
    vehicle.index = 200  # odometry begins at 0.4 s
    vehicle.send(0.100)
    vehicle.advance(0.45)
    detection = vehicle.answer(1)
    assert not detection.found and "older than the odometry" in detection.message
    assert detection.pose_camera.pose.position.z == pytest.approx(1.7 - 0.05 - 0.15, abs=0.02)
    assert vehicle.poses == []


def test_fused_mode_gains_certainty(graph):
    vehicle = graph(mode="fused")
    for k in range(6):
        vehicle.send(0.1 + k / 30)
        vehicle.advance(0.15 + k / 30)
        vehicle.answer(k + 1)
    assert [d.frames_fused for d in vehicle.detections] == [1, 2, 3, 4, 5, 6]
    first, last = (np.array(p.pose.covariance).reshape(6, 6)[:3, :3] for p in (vehicle.poses[0], vehicle.poses[-1]))
    assert np.trace(last) < np.trace(first)
    assert target_error(vehicle.poses[-1].pose.pose)[0] < 0.01


def test_average_mode_keeps_the_first_complete_image(graph):
    """[M:sec. IV-B] the first image with all four tags is the target, and stays it."""
    vehicle = graph(mode="average")
    for k in range(3):
        vehicle.send(0.1 + k / 30)
        vehicle.advance(0.15 + k / 30)
        vehicle.answer(k + 1)
    assert len(vehicle.poses) == 1
    assert all(d.method == "average" and d.pose.pose == vehicle.poses[0].pose.pose for d in vehicle.detections)
    distance, degrees = target_error(vehicle.poses[0].pose.pose)
    assert distance < 0.02 and degrees < 2.0


@pytest.mark.parametrize(("name", "value", "why"), [
    ("mode", "best", "average"), ("camera", "rear", "front"), ("localizer.search_rate", -1.0, "search_rate"),
    ("board", "no_such_board", "pad_four_tags")])
def test_refuses_parameters_by_name(graph, name, value, why):
    with pytest.raises(ConfigError, match=why):
        graph(**{name: value})
