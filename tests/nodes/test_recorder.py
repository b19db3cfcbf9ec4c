"""The recorder keeps what anybody publishes."""

from __future__ import annotations

import time

from mcap.reader import make_reader
from nodes.node_process import PATIENCE, nodes, watching
from perch_eval.domain import reserved_domain
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Imu

SENT = 100


def test_samples_of_a_best_effort_driver_are_recorded(tmp_path, monkeypatch):
    file = tmp_path / "flight.mcap"
    with reserved_domain() as domain:
        monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
        with nodes(("recorder",), tmp_path, parameters={"recorder": {"file": str(file)}}), watching() as (node, executor):
            imu = node.create_publisher(Imu, "imu/data_raw", QoSProfile(depth=SENT, reliability=ReliabilityPolicy.BEST_EFFORT))
            end = time.monotonic() + PATIENCE
            while not imu.get_subscription_count():
                assert time.monotonic() < end, "no subscription takes it"
                executor.spin_once(timeout_sec=0.05)
            sample = Imu()
            sample.header.frame_id = "imu_link"
            for k in range(SENT):
                sample.header.stamp.sec, sample.header.stamp.nanosec = 10, k * 5_000_000
                imu.publish(sample)
                executor.spin_once(timeout_sec=0.005)
            time.sleep(0.5)  # the last sample is on its way
    with file.open("rb") as stream:
        kept = [channel.topic for _, channel, _ in make_reader(stream).iter_messages()]
    assert kept.count("/imu/data_raw") > 0.9 * SENT
