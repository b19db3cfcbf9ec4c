"""Node `target_localizer` in a lockstep played by the test: one answer and one report per image, whatever it holds."""

import numpy as np
import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped
from nodes.played_vehicle import PlayedVehicle, played
from perch_core import so3
from perch_core.errors import ConfigError
from perch_core.ros import qos
from perch_core.ros.conversions import nanoseconds, pose_arrays, to_seconds
from perch_core.scenario import load_scenario
from perch_core.vehicle import load_vehicle
from perch_msgs.msg import TargetDetection
from perch_perception import target_localizer_node
from perch_sim.rendering import Renderer, build_scene
from sensor_msgs.msg import Image

MOUNT = load_vehicle("snapdragon").mounts["front"]
SCENARIO = load_scenario("surface_60")


@pytest.fixture(scope="module")
def renderer():
    return Renderer(build_scene(SCENARIO, seed=2), MOUNT, seed=2)


class Vehicle(PlayedVehicle):
    """Flies towards the pad."""

    start, velocity, mount = np.array([0.0, 0.0, 1.2]), np.array([1.5, 0.0, 0.0]), MOUNT

    def __init__(self, *graph):
        super().__init__(*graph)
        self.detections, self.poses = [], []
        self.node.create_subscription(TargetDetection, "target/detections", self.detections.append, qos.GATED)
        self.node.create_subscription(PoseWithCovarianceStamped, "target/pose", self.poses.append, qos.GATED)

    def send(self, exposed, pixels=None, **fields):
        """An image exposed at a true time [s]; its stamp carries the camera's offset."""
        if pixels is None:
            pixels = self.renderer.render([(self.position(exposed), np.eye(3))], self.rng)
        msg = Image(height=480, width=640, step=640, encoding="mono8")
        msg.data = pixels.tobytes()
        msg.header.stamp = self.stamp(exposed)
        for name, value in fields.items():
            setattr(msg, name, value)
        self.images.publish(msg)
        return nanoseconds(msg.header.stamp)

    def answer(self, count):
        self.spin_until(lambda: len(self.detections) >= count and len(self.triggers()) >= count, f"answer {count}")
        return self.detections[count - 1]


@pytest.fixture
def graph(ros_domain, renderer):
    with played(target_localizer_node, ros_domain, renderer, Vehicle) as start:
        yield start


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
