"""A vehicle at rest from plain publishers: nothing of perch is imported but messages.

`states.py RATE COUNT [clock]`: COUNT motor commands at RATE; `clock`: publish /clock, too. What came back is printed as JSON.
"""

import json
import sys
import time

import rclpy
from nav_msgs.msg import Odometry
from perch_msgs.msg import ControllerCommand, MotorCommand
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy, qos_profile_sensor_data
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Imu

WINDOW = 20   # samples without an answer of both nodes, at most, once there has been one: a busy machine loses nothing
LOST = 5.0    # [s] before both answer in time, what is still to come after so long was lost
PATIENCE = 250.0  # [s]


class Rest(Node):
    def __init__(self, rate: float, clock: bool) -> None:
        super().__init__("plain_states")
        self.imu = self.create_publisher(Imu, "imu/data_raw", qos_profile_sensor_data)
        self.vio = self.create_publisher(Odometry, "vio/odometry", qos_profile_sensor_data)
        self.order = self.create_publisher(ControllerCommand, "controller/command", 10)
        self.clock = self.create_publisher(Clock, "/clock", 10) if clock else None
        self.sent, self.states, self.commands, self.speeds = [], [], [], []
        self.heard = time.monotonic()
        self.begun = None  # stamp from which on both answer in time
        deep = QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT)
        self.create_subscription(Odometry, "odometry", self.take_state, deep)
        self.create_subscription(MotorCommand, "motor_command", self.take_command, deep)
        self.stamp, self.period, self.every = time.time_ns(), round(1e9 / rate), max(1, round(rate / 30.0))
        self.create_timer(1.0 / rate, self.step)

    def take_state(self, msg) -> None:
        self.heard = time.monotonic()
        self.states.append(nanoseconds(msg.header.stamp))
        if len(self.states) % 50 == 0 and not self.speeds:  # the controller may not have discovered this script yet
            self.command(ControllerCommand.ARM)

    def take_command(self, msg) -> None:
        self.heard = time.monotonic()
        self.commands.append(nanoseconds(msg.header.stamp))
        if msg.armed:
            self.speeds = list(map(float, msg.rotor_speed))

    def command(self, what: int) -> None:
        order = ControllerCommand(command=what, reason="a plain script says so")
        order.header.stamp.sec, order.header.stamp.nanosec = divmod(self.stamp, 10**9)
        self.order.publish(order)

    def step(self) -> None:
        if self.states and self.commands:
            if self.stamp - min(self.states[-1], self.commands[-1]) <= WINDOW * self.period:
                self.begun = self.begun or self.stamp + self.period
            elif self.begun or time.monotonic() - self.heard < LOST:
                return
        self.stamp += self.period
        imu = Imu()
        imu.header.stamp.sec, imu.header.stamp.nanosec = divmod(self.stamp, 10**9)
        imu.header.frame_id, imu.linear_acceleration.z = "imu_link", 9.81
        if self.clock:
            self.clock.publish(Clock(clock=imu.header.stamp))
        self.imu.publish(imu)
        self.sent.append(self.stamp)
        if len(self.sent) % self.every == 0:
            state = Odometry()
            state.header.stamp, state.header.frame_id, state.child_frame_id = imu.header.stamp, "odom", "base_link"
            state.pose.pose.orientation.w = 1.0
            for i in range(6):
                state.pose.covariance[7 * i], state.twist.covariance[7 * i] = 1e-4, 1e-3
            self.vio.publish(state)


def nanoseconds(stamp) -> int:
    return stamp.sec * 10**9 + stamp.nanosec


rclpy.init()
node, count, end = Rest(float(sys.argv[1]), "clock" in sys.argv), int(sys.argv[2]), time.monotonic() + PATIENCE
while (len(node.commands) < count or not node.speeds) and time.monotonic() < end:
    rclpy.spin_once(node, timeout_sec=0.1)
node.command(ControllerCommand.DISARM)
for _ in range(20):
    rclpy.spin_once(node, timeout_sec=0.02)
types = {kind for _, kinds in node.get_topic_names_and_types() for kind in kinds}
print(json.dumps({"begun": node.begun, "sent": node.sent, "states": node.states, "commands": node.commands, "speeds": node.speeds,
                  "types": sorted(types), "nodes": node.get_node_names()}))
