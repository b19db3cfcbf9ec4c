"""The vehicle as a test plays it for a node that looks through the front camera."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import ModuleType

import numpy as np
import rclpy
from nav_msgs.msg import Odometry
from perch_core.camera import CameraMount
from perch_core.ros import qos
from perch_core.ros.conversions import fill_odometry, nanoseconds, to_seconds, to_stamp
from perch_core.timing import CONTROL_PERIOD_NS
from perch_msgs.msg import Step, StepReport
from rclpy.experimental import EventsExecutor
from rclpy.parameter import Parameter
from sensor_msgs.msg import Image


class PlayedVehicle:
    """Sends odometry, steps and images of a straight flight, and keeps the node's reports.

    Attributes:
        start, velocity: of the flight in W [m], [m/s], shape (3,).
        attitude: xyzw.
        sigma: 1 sigma of the position that the odometry claims [m].
        mount: the camera.
    """

    start: np.ndarray
    velocity: np.ndarray
    mount: CameraMount
    attitude = np.array([0.0, 0.0, 0.0, 1.0])
    sigma = 0.01

    def __init__(self, context, executor, renderer):
        self.node = rclpy.create_node("test_vehicle", context=context)
        executor.add_node(self.node)
        self.executor, self.renderer, self.index = executor, renderer, 0
        self.rng = np.random.default_rng(0)
        self.reports: list[StepReport] = []
        self.odometry = self.node.create_publisher(Odometry, "odometry", qos.CHAIN)
        self.ticks = self.node.create_publisher(Step, "tick", qos.STEP)
        self.images = self.node.create_publisher(Image, "camera_front/image_raw", qos.IMAGE)
        self.node.create_subscription(StepReport, "step_report", self.reports.append, qos.GATED)

    def position(self, t: float) -> np.ndarray:
        """Where it is at a time [s]."""
        return self.start + t * self.velocity

    def spin_until(self, condition: Callable[[], bool], what: str) -> None:
        """Run callbacks until something has happened."""
        for _ in range(1000):
            if condition():
                return
            self.executor.spin_once(timeout_sec=0.01)
        raise AssertionError(f"never saw {what}")

    def advance(self, until: float) -> None:
        """Steps with odometry up to a time [s]."""
        while self.index * CONTROL_PERIOD_NS < round(until * 1e9):
            stamp = to_stamp(self.index * CONTROL_PERIOD_NS)
            msg = Odometry()
            msg.header.stamp = stamp
            fill_odometry(msg, self.position(to_seconds(stamp)), self.attitude, self.velocity, np.zeros(3))
            msg.pose.covariance = np.diag([self.sigma**2] * 3 + [1e-5] * 3).ravel()
            self.odometry.publish(msg)
            self.ticks.publish(Step(stamp=stamp, index=self.index, lockstep=True))
            self.index += 1

    def stamp(self, exposed: float):
        """The board's stamp of an image that was exposed at a true time [s]."""
        return to_stamp(round((exposed + self.mount.stamp_offset) * 1e9))

    def triggers(self) -> list[int]:
        """Stamps of the images that were reported [ns]."""
        return [nanoseconds(r.trigger) for r in self.reports if nanoseconds(r.trigger) > 0]


@contextmanager
def played(module: ModuleType, domain: int, renderer, kind: type[PlayedVehicle]) -> Iterator[Callable[..., PlayedVehicle]]:
    """A function that starts a node with parameters beside a played vehicle, and returns the vehicle when both know each other."""
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=domain)
    executor = EventsExecutor(context=context)
    nodes = []

    def start(kind: type[PlayedVehicle] = kind, **parameters) -> PlayedVehicle:
        node = module.create(context=context, parameter_overrides=[Parameter(k, value=v) for k, v in parameters.items()])
        executor.add_node(node)
        vehicle = kind(context, executor, renderer)
        nodes.extend((node, vehicle.node))
        vehicle.spin_until(lambda: vehicle.reports and vehicle.images.get_subscription_count()
                           and vehicle.odometry.get_subscription_count() and vehicle.ticks.get_subscription_count(),
                           "the node's greeting and subscriptions")
        return vehicle

    yield start
    for node in nodes:
        node.destroy_node()
    rclpy.shutdown(context=context)
