"""A vehicle at rest, from plain publishers of messages alone: `states.py RATE COUNT [clock]` prints what came back as JSON."""
import json
import sys
import time

import rclpy
from nav_msgs.msg import Odometry
from perch_msgs.msg import ControllerCommand, MotorCommand
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Imu

WINDOW, LOST = 20, 5.0  # samples without an answer, at most; until both nodes answer in time, answers are lost after so long [s]
period, count, end = round(1e9 / float(sys.argv[1])), int(sys.argv[2]), time.monotonic() + 250.0  # [ns], motor commands, [s]
seen = dict(begun=None, heard=0.0, sent=[time.time_ns()], states=[], commands=[], speeds=[])  # begun: since then both answer
rclpy.init()
node, qos = rclpy.create_node("plain_states"), QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT)
imu, vio = node.create_publisher(Imu, "imu/data_raw", qos), node.create_publisher(Odometry, "vio/odometry", qos)
order = node.create_publisher(ControllerCommand, "controller/command", 10)
clock = node.create_publisher(Clock, "/clock", 10) if "clock" in sys.argv else None
force, pose = Imu(), Odometry(child_frame_id="base_link")
force.header.frame_id, pose.header.frame_id, pose.header.stamp = "imu_link", "odom", force.header.stamp  # one stamp of both
force.linear_acceleration.z, pose.pose.pose.orientation.w = 9.81, 1.0
pose.pose.covariance[::7], pose.twist.covariance[::7] = 1e-4, 1e-3

def give(command):
    order.publish(ControllerCommand(header=force.header, command=command, reason="a plain script says so"))

def take(answer, what):
    seen["heard"] = time.monotonic()
    seen[what].append(answer.header.stamp.sec * 10**9 + answer.header.stamp.nanosec)
    if what == "commands" and answer.armed:
        seen["speeds"] = answer.rotor_speed.tolist()
    if what == "states" and len(seen[what]) % 50 == 0 and not seen["speeds"]:  # the controller may not know it yet
        give(ControllerCommand.ARM)

def send():
    stamp = seen["sent"][-1] + period
    if seen["states"] and seen["commands"]:
        if stamp - min(seen["states"][-1], seen["commands"][-1]) <= WINDOW * period:
            seen["begun"] = seen["begun"] or stamp
        elif seen["begun"] or time.monotonic() - seen["heard"] < LOST:
            return
    seen["sent"].append(stamp)
    force.header.stamp.sec, force.header.stamp.nanosec = divmod(stamp, 10**9)
    if clock:
        clock.publish(Clock(clock=force.header.stamp))
    imu.publish(force)
    if len(seen["sent"]) % max(1, round(1e9 / 30.0 / period)) == 0:
        vio.publish(pose)

node.create_subscription(Odometry, "odometry", lambda answer: take(answer, "states"), qos)
node.create_subscription(MotorCommand, "motor_command", lambda answer: take(answer, "commands"), qos)
node.create_timer(1e-9 * period, send)
while (len(seen["commands"]) < count or not seen["speeds"]) and time.monotonic() < end:
    rclpy.spin_once(node, timeout_sec=0.1)
give(ControllerCommand.DISARM)
types = [kind for _, kinds in node.get_topic_names_and_types() for kind in kinds]
print(json.dumps(seen | {"nodes": node.get_node_names(), "types": types}))
time.sleep(0.4)  # the last message is on its way
