"""Nonsense from anybody on any topic and service: a node says one typed line, lives, and goes on answering what is good."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from typing import Any

import pytest
from fuzzing.spoiled import kinds, plain_ways, spoilt
from nav_msgs.msg import Odometry
from nodes.good import messages, requests
from nodes.node_process import PATIENCE, Running, plain, watching
from perch_core.ros import topics
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

PERIOD = 10_000_000  # of the good samples [ns]
AGAIN = 0.2          # [s] a line of one kind is said once a second: what shall lead to one is sent this often until it does
STAMPS = ("header.stamp is past", "header.stamp is negative", "header.stamp is future")
POSE = ("pose.pose.position.x is nan", "pose.pose.position.y is inf", "pose.pose.orientation is zero", "pose.pose.orientation.x is 1e+300")
CAMERA = ("distortion_model is nonsense", "d is huge", "d.0 is nan", "k.0 is nan", "k.0 is 1e+300", "width is its largest")
IMAGE = ("height is its largest", "encoding is nonsense", "step is its largest", "data is empty", "data is cut short")
ORDER = ("header.stamp is future", "header.stamp is past", "header.frame_id is elsewhere", "at_end is its largest")

REFUSED = [  # topic, what is wrong, who says so, and what with
    ("imu/data_raw", ("linear_acceleration.x is nan", "linear_acceleration.y is inf", "linear_acceleration.z is 1e+300", *STAMPS),
     ("estimator", "vio", "controller", "mission"), "imu/data_raw"),
    ("imu/data_raw", ("angular_velocity.x is nan", "header.frame_id is elsewhere"), ("estimator", "vio", "controller"), "imu/data_raw"),
    ("vio/odometry", (*POSE, *STAMPS, "header.frame_id is elsewhere", "pose.covariance.0 is nan"), ("estimator",), "vio/odometry"),
    ("vio/state", ("position.x is nan", "orientation is zero", "velocity.z is inf", "covariance.0 is nan", "covariance.0 is 1e+300", *STAMPS,
                   "header.frame_id is elsewhere"), ("estimator",), "vio/state"),
    ("odometry", (*POSE, *STAMPS), ("target_localizer", "controller", "mission"), "odometry"),
    ("odometry", ("header.frame_id is elsewhere",), ("target_localizer", "controller", "mission"), "odometry"),
    ("odometry", ("pose.covariance.0 is nan",), ("target_localizer",), "odometry"),
    ("odometry", POSE[:3], ("description",), "odometry"),
    ("/tf_static", ("transforms.0.transform.translation.x is nan", "transforms.0.transform.rotation is zero"), ("estimator", "vio", "target_localizer"),
     "/tf_static"),
    ("camera_down/camera_info", CAMERA, ("vio",), "camera_info"), ("camera_front/camera_info", CAMERA, ("target_localizer",), "camera_info"),
    ("camera_down/image_raw", IMAGE, ("vio",), "image"), ("camera_front/image_raw", (*IMAGE, *STAMPS), ("target_localizer",), "image"),
    ("target/pose", (*POSE, "header.frame_id is elsewhere", "header.stamp is future", "pose.covariance.0 is nan"), ("mission",), "target/pose"),
    ("powerlines", ("lines is huge", "lines.0.start.x is nan", "lines.0.radius is inf", "lines.0.covariance.0 is nan", "header.stamp is future",
                    "header.frame_id is elsewhere"), ("mission",), "powerlines"),
    ("estimator/status", ("state is its largest", "vio_age is nan", *STAMPS), ("controller",), "estimator/status"),
    ("estimator/status", ("state is its largest", *STAMPS[:2]), ("mission",), "estimator/status"),
    ("controller/status", ("state is its largest", *STAMPS[:2]), ("mission",), "controller/status"),
    ("trajectory", (*ORDER, "segments is empty", "segments is huge", "segments.0.x is empty", "segments.0.y is huge", "segments.0.z.0 is nan",
                    "segments.0.duration is inf", "contact_time is nan", "recovery_start is 1e+300"), ("controller",), "trajectory"),
    ("recovery", (*ORDER[2:], "points is empty", "points is huge", "points.0.pose.orientation is zero", "points.0.linear_velocity.x is nan",
                  "points.0.rotor_thrust.0 is nan"), ("controller",), "recovery|way out"),
    ("controller/command", ("command is its largest", "header.stamp is past"), ("controller",), "command"),
]


class Stranger:
    """Publishes good messages of the present, and others between them."""

    def __init__(self, node: Node, executor: SingleThreadedExecutor) -> None:
        self.node, self._executor = node, executor
        self.stamp, self._answered, self._steps = time.time_ns(), 0, 0
        good = messages(self.stamp)
        self.topics = tuple(good)
        self.publishers = {topic: self.node.create_publisher(type(message), topic, topics.topic(topic).qos.publish) for topic, message in good.items()}
        self.node.create_subscription(Odometry, "odometry", self._hear, topics.topic("odometry").qos.subscribe)
        self._until(lambda: self.publishers["imu/data_raw"].get_subscription_count() >= 4, "the nodes are not there")
        self._until(self._begun, "the estimator does not answer")

    def _begun(self) -> bool:
        """One more good sample, no faster than in a flight: the estimator answers those of the present."""
        time.sleep(PERIOD * 1e-9)
        for _ in range(10):  # what was answered meanwhile
            self._executor.spin_once(timeout_sec=0.0)
        return self._go_on() and self._answered >= self.stamp - 5 * PERIOD

    def _hear(self, message: Odometry) -> None:
        stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
        if stamp <= self.stamp:
            self._answered = max(self._answered, stamp)

    def _until(self, done, problem: str) -> None:
        for _ in range(round(PATIENCE / 0.01)):
            if done():
                return
            self._executor.spin_once(timeout_sec=0.01)
        raise AssertionError(problem)

    def _go_on(self) -> bool:
        """A good sample, and every third time what VIO says of it; camera models at first, which the nodes then know."""
        self.stamp += PERIOD
        self._steps += 1
        good = messages(self.stamp)
        self.publishers["imu/data_raw"].publish(good["imu/data_raw"])
        if self._steps % 3 == 0:
            self.publishers["vio/odometry"].publish(good["vio/odometry"])
        if self._steps < 50:
            for topic in self.topics:
                if topic.endswith("camera_info"):
                    self.publishers[topic].publish(good[topic])
        return True

    def go_on(self) -> None:
        """A good sample, answered; one that nobody could take, as its process was stopped for long, is followed by the next."""
        stamp = self.stamp + PERIOD
        self._until(lambda: self._answered >= stamp or (self._go_on() and False), "a good sample is not answered")

    def good(self) -> dict[str, Any]:
        """Messages of the present."""
        return messages(self.stamp + PERIOD // 2)

    def ask(self, kind, name: str, request):
        """The answer to a request."""
        client = self.node.create_client(kind, name)
        self._until(client.service_is_ready, f"{name} is not there")
        future = client.call_async(request)
        self._until(future.done, f"{name} does not answer")
        self.node.destroy_client(client)
        return future.result()


@pytest.fixture(scope="module")
def stranger(free: dict[str, Running]) -> Iterator[Stranger]:
    """Beside the nodes; the graph discovers it once."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_DOMAIN_ID", free["estimator"].domain)
        with watching() as (node, executor):
            yield Stranger(node, executor)


def test_what_is_wrong_is_said(stranger, graph):
    waiting: dict[str, list[tuple[str, dict[str, str]]]] = {}  # topic -> what is wrong, node -> words
    for topic, all_wrong, names, words in REFUSED:
        waiting.setdefault(topic, []).extend((wrong, dict.fromkeys(names, words)) for wrong in all_wrong)
    begun: dict[str, dict[str, int]] = {}
    end = time.monotonic() + PATIENCE
    while waiting:  # one of each topic at a time, so that a line can be told from the next
        assert time.monotonic() < end, {topic: some[0] for topic, some in waiting.items()}
        good = stranger.good()
        for topic, some in waiting.items():
            begun.setdefault(topic, {name: len(graph[name].log) for name in some[0][1]})
            stranger.publishers[topic].publish(spoilt(good[topic], [plain_ways(good[topic])[some[0][0]]]))
        stranger.go_on()
        time.sleep(AGAIN)
        for topic, some in list(waiting.items()):
            if all(re.search(words, graph[name].log[begun[topic][name]:]) for name, words in some[0][1].items()):
                some.pop(0), begun.pop(topic)
                if not some:
                    del waiting[topic]
    for node in graph.values():
        assert max(map(len, node.log.splitlines()), default=0) < 500, f"{node.name}: more than a line"


def test_whatever_is_sent_every_node_goes_on(stranger, graph):
    for topic in stranger.topics:
        for _, message in kinds(stranger.good()[topic]):
            stranger.publishers[topic].publish(message)
        stranger.go_on()
    seen = plain("states.py", "200", "200")
    assert len(seen["commands"]) >= 200 and min(seen["speeds"]) > 100.0


@pytest.mark.parametrize("name", ["plan_perch", "plan_powerline", "set_controller"])
def test_every_request_is_answered(name, stranger, graph):
    kind, request = requests()[name]
    asked = 0
    for wrong, message in kinds(request):
        if wrong.split()[-1] in ("nan", "zero", "empty", "huge", "nonsense", "largest"):
            answer, asked = stranger.ask(kind, name, message), asked + 1
            assert answer.success or (answer.error_code and answer.message), wrong
    assert asked
    assert stranger.ask(kind, name, request).success
    stranger.go_on()
