"""Conversions of the estimator's health, and ground truth."""

from __future__ import annotations

from geometry_msgs.msg import PoseStamped as PoseStampedMessage
from perch_core.ros.messages.basic import floats, header, quaternion_floats, stamp_value, to_pose, to_vector
from perch_core.values import Contact, EstimatorHealth, PoseStamped
from perch_msgs.msg import Contact as ContactMessage
from perch_msgs.msg import EstimatorStatus


def health_value(msg: EstimatorStatus) -> EstimatorHealth:
    """Convert `perch_msgs/EstimatorStatus` to the estimator's health."""
    return EstimatorHealth(
        stamp_value(msg.header.stamp), msg.state, msg.vio_age, msg.updates_accepted, msg.updates_rejected, msg.nis, floats(msg.gyro_bias),
        floats(msg.accel_bias), msg.position_sigma, msg.attitude_sigma, msg.message)


def health_message(health: EstimatorHealth) -> EstimatorStatus:
    """Convert the estimator's health to `perch_msgs/EstimatorStatus`."""
    return EstimatorStatus(
        header=header(health.stamp, "map"), state=int(health.state), vio_age=float(health.vio_age), updates_accepted=int(health.accepted),
        updates_rejected=int(health.rejected), nis=float(health.nis), gyro_bias=to_vector(health.gyro_bias),
        accel_bias=to_vector(health.accel_bias), position_sigma=float(health.position_sigma), attitude_sigma=float(health.attitude_sigma),
        message=health.message)


def contact_value(msg: ContactMessage) -> Contact:
    """Convert from `perch_msgs/Contact`."""
    return Contact(stamp_value(msg.header.stamp), msg.state, msg.body, msg.normal_speed, msg.tangential_speed, msg.tilt_error, msg.offset, msg.reason)


def contact_message(contact: Contact) -> ContactMessage:
    """Convert to `perch_msgs/Contact`."""
    return ContactMessage(
        header=header(contact.stamp, "map"), state=int(contact.state), body=contact.body, normal_speed=float(contact.normal_speed),
        tangential_speed=float(contact.tangential_speed), tilt_error=float(contact.tilt_error), offset=float(contact.offset), reason=contact.reason)


def pose_value(msg: PoseStampedMessage) -> PoseStamped:
    """Convert from `geometry_msgs/PoseStamped`."""
    return PoseStamped(stamp_value(msg.header.stamp), floats(msg.pose.position), quaternion_floats(msg.pose.orientation))


def pose_message(pose: PoseStamped) -> PoseStampedMessage:
    """Convert to `geometry_msgs/PoseStamped` in `map`."""
    return PoseStampedMessage(header=header(pose.stamp, "map"), pose=to_pose(pose.p, pose.q))
