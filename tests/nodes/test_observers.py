"""Recorder and viewer take whatever anybody publishes: the recording stays readable and within its time, and nothing fails."""

from __future__ import annotations

import time

from fuzzing.spoiled import kinds
from mcap.reader import make_reader
from nodes.good import messages
from nodes.node_process import PATIENCE, nodes, watching
from perch_core.ros import topics
from perch_eval.domain import reserved_domain


def test_nonsense_on_every_topic_is_recorded_at_its_arrival_and_ends_no_observer(tmp_path, monkeypatch):
    file, began = tmp_path / "flight.mcap", time.time_ns()
    parameters = {"recorder": {"file": str(file)}, "viewer": {"port": 0}}
    with reserved_domain() as domain:
        monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
        with nodes(("recorder", "viewer"), tmp_path, parameters=parameters) as running, watching() as (node, executor):
            publishers = {topic: node.create_publisher(type(message), topic, topics.topic(topic).qos.publish)
                          for topic, message in messages(began).items()}
            end = time.monotonic() + PATIENCE
            while not publishers["trajectory"].get_subscription_count() == publishers["odometry"].get_subscription_count() == 2:
                assert time.monotonic() < end, "nobody takes them"
                executor.spin_once(timeout_sec=0.05)
            for topic, message in messages(time.time_ns()).items():
                for _, spoilt in kinds(message):
                    publishers[topic].publish(spoilt)
                    publishers["odometry"].publish(messages(time.time_ns())["odometry"])
                    executor.spin_once(timeout_sec=0.005)
            time.sleep(0.5)  # the last one is on its way
            for one in running.values():
                one.check()
                assert "unexpected exception" not in one.log
    with file.open("rb") as stream:
        logged = [(channel.topic, message.log_time) for _, channel, message in make_reader(stream).iter_messages()]
    assert {"/odometry", "/trajectory", "/tf_static"} <= {topic for topic, _ in logged}
    assert began - 10**10 < min(time for _, time in logged) and max(time for _, time in logged) < time.time_ns() + 10**10
