"""A vehicle, a scripted controller and an observer in one process, for the tests of the node `vehicle`."""

from __future__ import annotations

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from perch_core.ros import qos
from perch_core.ros.conversions import nanoseconds
from perch_core.ros.lockstep import Participant
from perch_core.vehicle import load_vehicle
from perch_msgs.msg import Contact, MotorCommand, RotorState, Step
from perch_sim import vehicle_node, vio_model_node
from rclpy.experimental import EventsExecutor
from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, Image, Imu

HOVER = float(np.sqrt(load_vehicle("snapdragon").hover_thrust / 4 / load_vehicle("snapdragon").thrust_coefficient))
TOPICS = {"imu/data_raw": Imu, "ground_truth/odometry": Odometry, "ground_truth/target": PoseStamped,
          "rotor_state": RotorState, "contact": Contact, "step": Step, "/clock": Clock, "/diagnostics": DiagnosticArray,
          "camera_front/image_raw": Image, "camera_front/camera_info": CameraInfo, "camera_down/camera_info": CameraInfo,
          "vio/odometry": Odometry}


class Flight:
    """A vehicle, a scripted controller and an observer in one process, until a step."""

    def __init__(self, domain: int, vio: bool = False, silent_after: int | None = None, **parameters):
        self.context = rclpy.Context()
        rclpy.init(context=self.context, domain_id=domain)
        self.executor = EventsExecutor(context=self.context)
        self.seen = {topic: [] for topic in TOPICS}
        self.observer = rclpy.create_node("observer", context=self.context)
        for topic, kind in TOPICS.items():
            profile = qos.IMAGE if kind is Image else qos.LATCHED if topic == "ground_truth/target" else qos.CHAIN
            if topic in ("/clock", "/diagnostics"):
                profile = qos.STATUS
            self.observer.create_subscription(kind, topic, self.seen[topic].append, profile)
        self.controller = rclpy.create_node("controller", context=self.context)
        self.commands = self.controller.create_publisher(MotorCommand, "motor_command", qos.CHAIN)
        self.silent_after, self.answered = silent_after, 0
        Participant(self.controller).chain(Imu, "imu/data_raw", self.answer)
        parameters = {"cameras": "none", "participants": ["controller"] + ["vio_model"] * vio} | parameters
        overrides = [Parameter(name, value=value) for name, value in parameters.items()]
        self.nodes = [self.observer, self.controller]
        if vio:
            self.nodes.append(vio_model_node.create(context=self.context))
        self.vehicle = vehicle_node.create(context=self.context, parameter_overrides=overrides)
        for node in (*self.nodes, self.vehicle):
            self.executor.add_node(node)

    def answer(self, imu: Imu) -> None:
        if self.silent_after is not None and self.answered >= self.silent_after:
            return
        self.answered += 1
        msg = MotorCommand(armed=True, rotor_speed=[1.05 * HOVER] * 4)
        msg.header.stamp = imu.header.stamp
        self.commands.publish(msg)

    def fly(self, steps: int) -> dict[str, list]:
        for _ in range(200_000):
            if min(len(self.seen["step"]), len(self.seen["ground_truth/odometry"])) >= steps:  # the step itself comes first
                return self.seen
            self.executor.spin_once(timeout_sec=0.05)
        raise AssertionError(f"only {len(self.seen['step'])} of {steps} steps came")

    def close(self) -> None:
        if self.context.ok():
            self.vehicle.close()
            for node in (*self.nodes, self.vehicle):
                self.executor.remove_node(node)
                node.destroy_node()
            self.executor.shutdown()
            rclpy.shutdown(context=self.context)


def stamps(messages):
    return np.array([nanoseconds(m.header.stamp) for m in messages])


def seen_steps(flight):
    return flight.seen["step"]
