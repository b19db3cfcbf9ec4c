"""Serialised messages read and written in place, against rclpy's own conversion."""

import numpy as np
import pytest
from nav_msgs.msg import Odometry
from perch_msgs.msg import MotorCommand, Release, Step
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import CameraInfo, Imu

from perch_core.ros import wire
from perch_core.ros.conversions import fill_odometry, nanoseconds, odometry_arrays, to_stamp, to_vector

STAMP = 12_345_678_901
FRAMES = ["", "map", "base", "a_longer_frame"]  # every length modulo 8 that alignment can see
RNG = np.random.default_rng(1)


def unit(q):
    return q / np.linalg.norm(q)


@pytest.mark.parametrize("frame", [*FRAMES, *("x" * n for n in range(1, 9))])
def test_an_imu_message_survives_both_ways(frame):
    gyro, accel = RNG.normal(size=3), RNG.normal(size=3)
    msg = Imu(angular_velocity=to_vector(gyro), linear_acceleration=to_vector(accel))
    msg.header.stamp, msg.header.frame_id = to_stamp(STAMP), frame
    msg.orientation_covariance[0] = -1.0
    reading = wire.read_imu(serialize_message(msg))
    assert reading == (STAMP, tuple(gyro), tuple(accel))
    blank = Imu()
    blank.header.frame_id, blank.orientation_covariance[0] = frame, -1.0
    assert deserialize_message(wire.ImuTemplate(blank).fill(STAMP, gyro.tolist(), accel.tolist()), Imu) == msg


@pytest.mark.parametrize("child", ["", "base_link", "b"])
@pytest.mark.parametrize("frame", [*FRAMES, *("x" * n for n in range(1, 9))])
def test_an_odometry_message_survives_both_ways(frame, child):
    p, q, v, w = RNG.normal(size=3), unit(RNG.normal(size=4)), RNG.normal(size=3), RNG.normal(size=3)
    pose, twist = RNG.normal(size=(6, 6)), RNG.normal(size=(6, 6))
    msg = Odometry(child_frame_id=child)
    msg.header.stamp, msg.header.frame_id = to_stamp(STAMP), frame
    fill_odometry(msg, p, q, v, w)
    msg.pose.covariance, msg.twist.covariance = pose.ravel(), twist.ravel()
    data = serialize_message(msg)
    reading = wire.read_odometry(data)
    assert reading.stamp == nanoseconds(msg.header.stamp)
    for ours, theirs in zip(reading[1:], odometry_arrays(msg)):
        np.testing.assert_array_equal(ours, theirs)
    np.testing.assert_array_equal(wire.read_pose_covariance(data), pose)
    template = wire.OdometryTemplate(Odometry(header=msg.header, child_frame_id=child))
    template.covariances(pose, twist)
    # messages, not bytes: padding is whatever was in the buffer
    assert deserialize_message(template.fill(STAMP, p.tolist(), q.tolist(), v.tolist(), w.tolist()), Odometry) == msg


@pytest.mark.parametrize("frame", [*FRAMES, *("x" * n for n in range(1, 9))])
@pytest.mark.parametrize("armed", [False, True])
def test_a_motor_command_survives_both_ways(frame, armed):
    speeds = RNG.uniform(600.0, 1700.0, 4)
    msg = MotorCommand(armed=armed, rotor_speed=speeds)
    msg.header.stamp, msg.header.frame_id = to_stamp(STAMP), frame
    assert wire.read_motor_command(serialize_message(msg)) == (STAMP, armed, tuple(speeds))
    template = wire.MotorCommandTemplate(MotorCommand(header=msg.header))
    again = deserialize_message(template.fill(STAMP, armed, speeds.tolist()), MotorCommand)
    assert again.header == msg.header and again.armed == armed and np.array_equal(again.rotor_speed, speeds)


@pytest.mark.parametrize("released", [[], [("/vio/odometry", 3)], [("/a", 0), ("/target/pose", 2**40)]])
@pytest.mark.parametrize("lockstep", [False, True])
def test_a_step_is_read_and_written(released, lockstep):
    msg = Step(stamp=to_stamp(STAMP), index=2**33 + 7, lockstep=lockstep,
               released=[Release(topic=topic, count=count) for topic, count in released])
    reading = wire.read_step(serialize_message(msg))
    assert reading == (STAMP, 2**33 + 7, lockstep, tuple(released))
    assert deserialize_message(wire.write_step(reading), Step) == msg


@pytest.mark.parametrize("frame", FRAMES)
def test_a_camera_info_has_its_stamp_and_all_the_rest(frame):
    msg = CameraInfo(height=480, width=640, distortion_model="equidistant", d=[0.1, 0.2, 0.3, 0.4], k=RNG.normal(size=9))
    msg.header.frame_id = frame
    template = wire.CameraInfoTemplate(msg)
    msg.header.stamp = to_stamp(STAMP)
    assert deserialize_message(template.fill(STAMP), CameraInfo) == msg


def test_templates_keep_what_they_do_not_fill():
    blank = Odometry(child_frame_id="base_link")
    blank.header.frame_id = "map"
    template = wire.OdometryTemplate(blank)
    template.covariances(np.eye(6), 2.0 * np.eye(6))
    first = template.fill(STAMP, (1.0, 2.0, 3.0), (0.0, 0.0, 0.0, 1.0), (4.0, 5.0, 6.0), (7.0, 8.0, 9.0))
    template.fill(STAMP + 1, (0.0,) * 3, (0.0, 0.0, 0.0, 1.0), (0.0,) * 3, (0.0,) * 3)
    msg = deserialize_message(first, Odometry)
    assert (msg.header.frame_id, msg.child_frame_id) == ("map", "base_link")
    assert msg.pose.pose.position.z == 3.0 and msg.twist.twist.linear.x == 4.0
    assert msg.pose.covariance[0] == 1.0 and msg.twist.covariance[35] == 2.0
