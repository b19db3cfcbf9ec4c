"""Node `powerline_mapper` in a lockstep played by the test: a map from rendered wires, a report per image, refusals."""

import numpy as np
import pytest
import rclpy
from nav_msgs.msg import Odometry
from perch_core import so3
from perch_core.catenary import Catenary
from perch_core.errors import ConfigError
from perch_core.ros import qos
from perch_core.ros.conversions import fill_odometry, nanoseconds, to_array, to_seconds, to_stamp
from perch_core.vehicle import load_vehicle
from perch_msgs.msg import PowerlineArray, Step, StepReport
from perch_perception import powerline_mapper_node
from perch_sim.rendering import CableCurve, Renderer, Scene
from rclpy.experimental import EventsExecutor
from rclpy.parameter import Parameter
from sensor_msgs.msg import Image

STEP_NS = 2_000_000
MOUNT = load_vehicle("rpg").mounts["front"]
CABLES = [Catenary.from_sag(np.array([3.0, -4.0, z]), np.array([3.2, 4.0, z]), 0.05) for z in (1.9, 2.6)]
PITCH_UP = np.array([0.0, -np.sin(0.05), 0.0, np.cos(0.05)])


@pytest.fixture(scope="module")
def renderer():
    scene = Scene(np.array([-3.0, -4.5, 0.0]), np.array([9.0, 4.5, 6.0]), seed=1, contrast=0.25,
                  cables=tuple(CableCurve(c.sample(60), 0.03, (190.0, 35.0, 35.0)) for c in CABLES))
    return Renderer(scene, MOUNT, seed=1)


class Vehicle:
    """The test's side: it rises at 0.5 m/s and sends odometry, steps and images."""

    velocity = np.array([0.0, 0.0, 0.5])
    sigma = 0.005

    def __init__(self, context, executor, renderer):
        self.node = rclpy.create_node("test_vehicle", context=context)
        executor.add_node(self.node)
        self.executor, self.renderer, self.index = executor, renderer, 0
        self.rng = np.random.default_rng(0)
        self.maps, self.reports = [], []
        self.odometry = self.node.create_publisher(Odometry, "odometry", qos.CHAIN)
        self.ticks = self.node.create_publisher(Step, "tick", qos.STEP)
        self.images = self.node.create_publisher(Image, "camera_front/image_raw", qos.IMAGE)
        self.node.create_subscription(PowerlineArray, "powerlines", self.maps.append, qos.GATED)
        self.node.create_subscription(StepReport, "step_report", self.reports.append, qos.GATED)

    def position(self, t):
        return np.array([0.0, 0.0, 1.8]) + t * self.velocity

    def spin_until(self, condition, what):
        for _ in range(1000):
            if condition():
                return
            self.executor.spin_once(timeout_sec=0.01)
        raise AssertionError(f"never saw {what}")

    def advance(self, until):
        while self.index * STEP_NS < round(until * 1e9):
            stamp = to_stamp(self.index * STEP_NS)
            msg = Odometry()
            msg.header.stamp = stamp
            fill_odometry(msg, self.position(to_seconds(stamp)), PITCH_UP, self.velocity, np.zeros(3))
            msg.pose.covariance = np.diag([self.sigma**2] * 3 + [1e-5] * 3).ravel()
            self.odometry.publish(msg)
            self.ticks.publish(Step(stamp=stamp, index=self.index, lockstep=True))
            self.index += 1

    def fly(self, seconds, encoding="rgb8"):
        """Images at 30 Hz, each answered before the next."""
        R_WB = so3.quat_to_matrix(PITCH_UP)
        first = len(self.triggers())
        for k in range(int(30 * seconds)):
            exposed = 0.1 + k / 30
            pixels = self.renderer.render([(self.position(exposed), R_WB)], self.rng)
            msg = Image(height=480, width=640, step=1920, encoding=encoding, data=pixels.tobytes())
            msg.header.stamp = to_stamp(round((exposed + MOUNT.stamp_offset) * 1e9))
            self.images.publish(msg)
            self.advance(exposed + 0.02)
            self.spin_until(lambda: len(self.triggers()) == first + k + 1, f"the report of image {k}")
        return self.maps[-1] if self.maps else None

    def triggers(self):
        return [nanoseconds(r.trigger) for r in self.reports if nanoseconds(r.trigger) > 0]


@pytest.fixture
def graph(ros_domain, renderer):
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=ros_domain)
    executor = EventsExecutor(context=context)
    nodes = []

    def start(kind=Vehicle, **parameters):
        node = powerline_mapper_node.create(
            context=context, parameter_overrides=[Parameter(k, value=v) for k, v in parameters.items()])
        executor.add_node(node)
        vehicle = kind(context, executor, renderer)
        nodes.extend((node, vehicle.node))
        vehicle.spin_until(lambda: vehicle.reports and vehicle.images.get_subscription_count()
                           and vehicle.odometry.get_subscription_count() and vehicle.ticks.get_subscription_count(),
                           "the node")
        return vehicle

    yield start
    for node in nodes:
        node.destroy_node()
    rclpy.shutdown(context=context)


def test_maps_two_wires_and_reports_every_image(graph):
    vehicle = graph()
    last = vehicle.fly(1.7)
    assert len(set(vehicle.triggers())) == 51, "one report per image"
    assert len(vehicle.maps) == 17, "10 Hz of 30"
    counts = {r.topic: r.count for r in vehicle.reports[-1].published}
    assert counts == {"/powerlines": 17}
    assert last.header.frame_id == "map" and not last.degenerate and last.message == ""
    assert {line.id % 100 for line in last.lines} == {0, 1}
    for line in last.lines:
        start, end = to_array(line.start), to_array(line.end)
        cable = min((c.sample(800) for c in CABLES), key=lambda p: np.linalg.norm(p - start, axis=1).min())
        points = start + np.linspace(0, 1, 9)[:, None] * (end - start)
        assert np.mean([np.linalg.norm(cable - p, axis=1).min() for p in points]) < 0.02
        assert line.radius == pytest.approx(0.03, rel=0.25)
        covariance = np.array(line.covariance).reshape(3, 3)
        assert 0 < np.sqrt(np.linalg.eigvalsh(covariance)[-1]) < 0.15 and 0 < line.direction_sigma < 0.1
        assert line.observations >= 10


def test_says_that_a_motion_along_the_wires_determines_nothing(graph):
    class Sideways(Vehicle):
        velocity = np.array([0.0, 0.5, 0.0])

    last = graph(Sideways).fly(1.0)
    assert last.degenerate and list(last.lines) == [] and "baseline ratio" in last.message


def test_maps_nothing_while_the_odometry_is_unknown(graph):
    class Lost(Vehicle):
        sigma = 100.0

    last = graph(Lost).fly(0.5)
    assert list(last.lines) == [] and "100.00 m only" in last.message


def test_an_image_without_colour_is_refused_but_answered(graph):
    vehicle = graph()
    last = vehicle.fly(0.3, encoding="mono8")
    assert "no colour" in last.message and len(vehicle.triggers()) == 9


@pytest.mark.parametrize(("name", "value", "why"), [
    ("vehicle", "snapdragon", "no colour camera"), ("camera", "down", "front"), ("rate", 0.0, "rate"),
    ("mapper.triangulation.min_ratio", 2.0, "min_ratio")])
def test_refuses_parameters_by_name(graph, name, value, why):
    with pytest.raises(ConfigError, match=why):
        graph(**{name: value})
