"""The estimator's odometry as states of the body."""

from __future__ import annotations

import numpy as np
from perch_core.ros.conversions import seconds
from perch_core.ros.wire import read_odometry, read_pose_covariance

from perch_perception.pose_buffer import BodyState


def body_state(data: bytes) -> BodyState:
    """State in a serialised `nav_msgs/Odometry`."""
    stamp, p, q, v, w = read_odometry(data)
    return BodyState(seconds(stamp), np.array(p), np.array(q), np.array(v), np.array(w), read_pose_covariance(data))
