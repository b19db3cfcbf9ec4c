"""config/perch.rviz: what it shows is published, with a QoS that its displays can subscribe to, in frames of the tree."""

from __future__ import annotations

import pytest
import yaml
from perch_core.config import config_dir
from perch_core.ros import topics
from rclpy.qos import DurabilityPolicy, LivelinessPolicy, QoSCompatibility, QoSProfile, ReliabilityPolicy, qos_check_compatible

TYPES = {"MarkerArray": "MarkerArray", "Odometry": "Odometry", "PoseWithCovariance": "PoseWithCovarianceStamped", "Image": "Image",
         "RobotModel": "String"}
LAYOUT = yaml.safe_load((config_dir() / "perch.rviz").read_text())["Visualization Manager"]
SHOWN = [display for display in LAYOUT["Displays"] if "Topic" in display or "Description Topic" in display]


def test_the_fixed_frame_is_the_world():
    assert LAYOUT["Global Options"]["Fixed Frame"] == LAYOUT["Views"]["Current"]["Target Frame"] == "map"
    assert len(SHOWN) == 6


@pytest.mark.parametrize("display", SHOWN, ids=lambda display: display["Name"])
def test_a_display_subscribes_to_what_is_published(display):
    wanted = display.get("Topic") or display["Description Topic"]
    row = topics.topic(wanted["Value"].lstrip("/"))
    assert row.message.__name__ == TYPES[display["Class"].rpartition("/")[2]]
    subscriber = QoSProfile(
        depth=wanted.get("Depth", 1),
        reliability=ReliabilityPolicy[wanted["Reliability Policy"].upper().replace(" ", "_")],
        durability=DurabilityPolicy[wanted["Durability Policy"].upper().replace(" ", "_")],
        liveliness=LivelinessPolicy.AUTOMATIC)
    publisher = row.qos.publish
    offered = QoSProfile(depth=publisher.depth, reliability=publisher.reliability, durability=publisher.durability,
                         liveliness=LivelinessPolicy.AUTOMATIC)
    compatible, why = qos_check_compatible(offered, subscriber)
    assert compatible == QoSCompatibility.OK, why
