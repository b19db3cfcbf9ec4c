"""The QoS profiles of the graph, by purpose.

Publishers are reliable throughout: a reliable publisher serves best-effort subscribers too, and in lockstep a lost
message would stop the vehicle. Gated and chain topics are transient local, so that a node that is matched late still
counts every message.
"""

from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy


def _profile(depth: int, latched: bool = False, reliable: bool = True) -> QoSProfile:
    return QoSProfile(
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


STEP = _profile(1000, latched=True)     # `step`: every participant sees every step
CHAIN = _profile(100, latched=True)     # imu, odometry, motor_command, status: one message per step (or per n steps)
GATED = _profile(100, latched=True)     # results of slow participants: trajectory, vio/odometry, target/pose, powerlines
LATCHED = _profile(1, latched=True)     # camera_info and other facts
IMAGE = _profile(5)                     # images
STATUS = _profile(10)                   # diagnostics, debug output
SENSOR = _profile(5, reliable=False)    # for subscribers that prefer the newest to the complete
