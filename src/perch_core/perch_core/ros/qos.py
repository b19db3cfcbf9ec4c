"""The QoS profiles of the graph, by purpose.

Publishers are reliable: a reliable publisher serves best-effort subscribers, too. Subscribers to sensors, images and the
clock are best effort, because drivers publish best effort and the newest message matters more than completeness.
Subscribers to statuses, results of perception and orders are reliable. What a late subscriber needs (facts, the newest
map) is transient local; orders are not: a restarted controller must not carry out an old one.
"""

from typing import NamedTuple

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy


class Qos(NamedTuple):
    """Profiles of one purpose: `publish` and `subscribe`."""

    publish: QoSProfile
    subscribe: QoSProfile


def _profile(depth: int, latched: bool = False, reliable: bool = True) -> QoSProfile:
    return QoSProfile(
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


SENSOR = Qos(_profile(200), _profile(200, reliable=False))        # imu, odometry, motor_command: up to 1000 Hz
IMAGE = Qos(_profile(5), _profile(5, reliable=False))             # images, camera_info
STATE = Qos(_profile(50), _profile(50))                           # statuses, results of perception
ORDER = Qos(_profile(50), _profile(50))                           # trajectories
COMMAND = Qos(_profile(500), QoSProfile(history=HistoryPolicy.KEEP_ALL, depth=0))  # commands: no later one displaces a KILL that waits
LATCHED = Qos(_profile(1, latched=True), _profile(1, latched=True))         # facts, the newest map
EVENT = Qos(_profile(100, latched=True), _profile(100, latched=True))       # contacts: all of them, also for late subscribers
STATIC = Qos(_profile(50, latched=True), _profile(50, latched=True))        # /tf_static
CLOCK = Qos(_profile(10), _profile(10, reliable=False))


def recording_profile(purpose: Qos, reliability: ReliabilityPolicy = ReliabilityPolicy.RELIABLE) -> QoSProfile:
    """Return the profile of a subscriber that records every message of a topic, with a queue for seconds of messages."""
    return QoSProfile(depth=2000, reliability=reliability, durability=purpose.publish.durability)
