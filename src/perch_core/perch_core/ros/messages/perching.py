"""Conversions of target poses and the map of powerlines."""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import PoseWithCovariance, PoseWithCovarianceStamped
from perch_core.errors import PerchError
from perch_core.ros.messages.basic import flat, floats, header, quaternion_floats, square, stamp_value, to_point, to_pose
from perch_core.values import MappedPowerline, PowerlineMap, TargetPose, TargetSighting
from perch_msgs.msg import Powerline, PowerlineArray, TargetDetection

FRAME = "map"


def _pose(stamp: int, msg: PoseWithCovariance) -> TargetPose:
    pose = msg.pose
    return TargetPose(stamp, np.array(floats(pose.position)), np.array(quaternion_floats(pose.orientation)), square(msg.covariance, 6))


def _pose_message(pose: TargetPose) -> PoseWithCovariance:
    return PoseWithCovariance(pose=to_pose(pose.p_WS, pose.q_WS), covariance=flat(pose.covariance))


def _check_frame(msg: PoseWithCovarianceStamped | PowerlineArray) -> None:
    if msg.header.frame_id != FRAME:
        raise PerchError(f"header.frame_id {msg.header.frame_id!r} is not {FRAME!r}")


def target_value(msg: PoseWithCovarianceStamped) -> TargetPose:
    """Convert `geometry_msgs/PoseWithCovarianceStamped` to the target's pose.

    Raises:
        PerchError: in another frame than `map`.
    """
    _check_frame(msg)
    return _pose(stamp_value(msg.header.stamp), msg.pose)


def target_message(pose: TargetPose) -> PoseWithCovarianceStamped:
    """Convert the target's pose to `geometry_msgs/PoseWithCovarianceStamped` in `map`."""
    return PoseWithCovarianceStamped(header=header(pose.stamp, FRAME), pose=_pose_message(pose))


def sighting_value(msg: TargetDetection) -> TargetSighting:
    """Convert `perch_msgs/TargetDetection` to a sighting."""
    stamp = stamp_value(msg.header.stamp)
    return TargetSighting(
        stamp, msg.found, _pose(stamp, msg.pose) if msg.found else None, _pose(stamp, msg.pose_camera) if len(msg.ids) else None,
        tuple(int(i) for i in msg.ids), msg.reprojection_rms, msg.frames_fused, msg.method, msg.message)


def sighting_message(sighting: TargetSighting) -> TargetDetection:
    """Convert a sighting to `perch_msgs/TargetDetection`."""
    msg = TargetDetection(
        header=header(sighting.stamp, FRAME), found=bool(sighting.found), ids=[int(i) for i in sighting.ids],
        reprojection_rms=float(sighting.reprojection_rms), frames_fused=int(sighting.frames_fused), method=sighting.method,
        message=sighting.message)
    if sighting.pose is not None:
        msg.pose = _pose_message(sighting.pose)
    if sighting.pose_camera is not None:
        msg.pose_camera = _pose_message(sighting.pose_camera)
    return msg


def powerline_value(msg: Powerline) -> MappedPowerline:
    """Convert from `perch_msgs/Powerline`."""
    return MappedPowerline(msg.id, floats(msg.start), floats(msg.end), msg.radius, square(msg.covariance, 3), msg.direction_sigma, msg.observations)


def powerline_message(line: MappedPowerline) -> Powerline:
    """Convert to `perch_msgs/Powerline`."""
    return Powerline(
        id=int(line.id), start=to_point(line.start), end=to_point(line.end), radius=float(line.radius), covariance=flat(line.covariance),
        direction_sigma=float(line.direction_sigma), observations=int(line.observations))


def map_value(msg: PowerlineArray) -> PowerlineMap:
    """Convert `perch_msgs/PowerlineArray` to the map.

    Raises:
        PerchError: in another frame than `map`.
    """
    _check_frame(msg)
    return PowerlineMap(stamp_value(msg.header.stamp), tuple(powerline_value(line) for line in msg.lines), msg.degenerate, msg.message)


def map_message(lines: PowerlineMap) -> PowerlineArray:
    """Convert the map to `perch_msgs/PowerlineArray`."""
    return PowerlineArray(header=header(lines.stamp, FRAME), lines=[powerline_message(line) for line in lines.lines],
                          degenerate=bool(lines.degenerate), message=lines.message)
