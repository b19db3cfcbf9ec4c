"""Table of all channels of the graph: message type, QoS, and conversions from message to value and back.

A new topic needs a new row. Ports name channels (`perch_core.component`); hosts look them up here.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from perch_core.component import Diagnostics
from perch_core.errors import PerchError
from perch_core.ros import qos
from perch_core.ros.messages import fast, flight, markers, mission, perching, planning, sensing, states
from perch_core.ros.messages.basic import stamp_value, to_stamp
from perch_core.ros.messages.diagnostics import diagnostics_message, diagnostics_value
from perch_core.ros.qos import Qos
from perch_core.values import NANOSECONDS
from perch_msgs.action import Perch
from perch_msgs.msg import (
    AttitudeThrust, Contact, ControllerCommand, ControllerStatus, ControlReference, EstimatorStatus, MotorCommand, PowerlineArray, RatesThrust,
    RotorState, TargetDetection, Trajectory, VioState)
from perch_msgs.srv import PlanPerch, PlanPowerline, SetController
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.qos import DurabilityPolicy
from rclpy.serialization import deserialize_message, serialize_message
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, Imu
from std_msgs.msg import String
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage
from visualization_msgs.msg import MarkerArray

Convert = Callable[[Any], Any]
IMAGE_MAX, TRAJECTORY_MAX = 64 << 20, 1 << 20  # bytes; a trajectory of that size is read in 0.2 s


@dataclass(frozen=True)
class Topic:
    """Row of a topic.

    Attributes:
        channel: relative name of the topic; `*` stands for a camera's name.
        message: type of its messages.
        qos: of publishers and subscribers.
        to_message: value to message.
        to_value: message to value, or to a list of values; raises PerchError for a message that cannot be converted.
        observed: no component in flight waits for it.
        size_max: greatest size of a message that is read [bytes].
        rate_max: greatest number of messages per second that a node reads; 0: no limit.
        packed: `to_message` returns the serialised message and `to_value` reads it, without rclpy's objects: frequent topics and images.
        """

    channel: str
    message: Any
    qos: Qos
    to_message: Convert
    to_value: Convert
    packed: bool = False
    observed: bool = False
    size_max: int = 256 << 10
    rate_max: int = 0

    def read(self, data: bytes) -> Any:
        """Return the value of a serialised message, or a list of values.

        Raises:
            PerchError: the message is larger than allowed, or cannot be converted.
        """
        if len(data) > self.size_max:
            raise PerchError(f"{len(data)} bytes are more than {self.size_max}")
        if self.packed:
            return self.to_value(data)
        try:
            message = deserialize_message(data, self.message)
        except rclpy_implementation.RMWError as error:
            raise PerchError(f"not a whole {self.message.__name__}: {error}") from None
        return self.to_value(message)

    @property
    def frequent(self) -> bool:
        """Whether its messages are so many that one wake-up of a reader serves several."""
        return self.packed and self.message is not Image

    @property
    def latched(self) -> bool:
        """Whether late subscribers receive messages that were published before."""
        return bool(self.qos.publish.durability == DurabilityPolicy.TRANSIENT_LOCAL)


@lru_cache(maxsize=1)
def _clock_message(stamp: int) -> Clock:
    """Return the message of a time [ns], the same one for all nodes of a process."""
    return Clock(clock=to_stamp(stamp))


TOPICS = (
    Topic("imu/data_raw", Imu, qos.SENSOR, fast.pack_imu, fast.unpack_imu, packed=True),
    Topic("camera_*/image_raw", Image, qos.IMAGE, sensing.pack_image, sensing.unpack_image, packed=True, size_max=IMAGE_MAX, rate_max=300),
    Topic("camera_*/image_raw/compressed", CompressedImage, qos.IMAGE, sensing.compressed_message, sensing.compressed_value, size_max=IMAGE_MAX,
          rate_max=300),
    Topic("camera_*/camera_info", CameraInfo, qos.IMAGE, sensing.camera_info_message, sensing.camera_info_value, rate_max=300),
    Topic("vio/debug_image", Image, qos.IMAGE, sensing.pack_image, sensing.unpack_image, packed=True, size_max=IMAGE_MAX),
    Topic("vio/odometry", Odometry, qos.SENSOR, fast.pack_odometry, fast.unpack_odometry, packed=True),
    Topic("vio/state", VioState, qos.SENSOR, fast.pack_inertial, fast.unpack_inertial, packed=True),
    Topic("odometry", Odometry, qos.SENSOR, fast.pack_odometry, fast.unpack_odometry, packed=True),
    Topic("estimator/status", EstimatorStatus, qos.STATE, states.health_message, states.health_value),
    Topic("target/pose", PoseWithCovarianceStamped, qos.LATCHED, perching.target_message, perching.target_value, rate_max=500),
    Topic("target/detections", TargetDetection, qos.STATE, perching.sighting_message, perching.sighting_value),
    Topic("powerlines", PowerlineArray, qos.LATCHED, perching.map_message, perching.map_value, rate_max=100),
    Topic("trajectory", Trajectory, qos.ORDER, flight.order_message, flight.order_value, size_max=TRAJECTORY_MAX, rate_max=50),
    Topic("recovery", Trajectory, qos.ORDER, flight.order_message, flight.order_value, size_max=TRAJECTORY_MAX, rate_max=50),
    Topic("controller/command", ControllerCommand, qos.COMMAND, flight.command_message, flight.command_value, rate_max=500),
    Topic("controller/status", ControllerStatus, qos.STATE, flight.status_message, flight.status_value),
    Topic("controller/reference", ControlReference, qos.STATE, flight.reference_message, flight.reference_value, observed=True),
    Topic("motor_command", MotorCommand, qos.SENSOR, fast.pack_motor, fast.unpack_motor, packed=True),
    Topic("rates_thrust_command", RatesThrust, qos.SENSOR, fast.pack_rates, fast.unpack_rates, packed=True),
    Topic("attitude_thrust_command", AttitudeThrust, qos.SENSOR, fast.pack_attitude, fast.unpack_attitude, packed=True),
    Topic("rotor_state", RotorState, qos.SENSOR, fast.pack_rotors, fast.unpack_rotors, packed=True, observed=True),
    Topic("contact", Contact, qos.EVENT, states.contact_message, states.contact_value),
    Topic("ground_truth/odometry", Odometry, qos.SENSOR, fast.pack_odometry, fast.unpack_odometry, packed=True, observed=True),
    Topic("ground_truth/target", PoseStamped, qos.LATCHED, states.pose_message, states.pose_value),
    Topic("/clock", Clock, qos.CLOCK, _clock_message, lambda msg: stamp_value(msg.clock), observed=True),
    Topic("/diagnostics", DiagnosticArray, qos.STATE, diagnostics_message, diagnostics_value),
    Topic("markers", MarkerArray, qos.STATE, markers.markers_message, markers.markers_value),
    Topic("/tf", TFMessage, qos.SENSOR, lambda value: TFMessage(transforms=[sensing.stamped_transform_message(value)]),
          lambda msg: [sensing.stamped_transform_value(one) for one in msg.transforms]),
    Topic("/tf_static", TFMessage, qos.STATIC, lambda value: TFMessage(transforms=[sensing.transform_message(value)]),
          lambda msg: [sensing.transform_value(one) for one in msg.transforms]),
    Topic("robot_description", String, qos.LATCHED, lambda text: String(data=text), lambda msg: msg.data),
)


def _no_client(_: Any) -> Any:
    raise PerchError("this service has no client conversions")


@dataclass(frozen=True)
class ServiceRow:
    """Row of a service: its type; conversions of the server (request to value, answer to message) and the client."""

    channel: str
    type: Any
    request_value: Convert
    answer_message: Convert
    request_message: Convert = _no_client
    answer_value: Convert = _no_client


SERVICES = (
    ServiceRow("plan_perch", PlanPerch, planning.perch_request_value, planning.perch_plan_message, planning.perch_request_message,
               planning.perch_plan_value),
    ServiceRow("plan_way_out", PlanPerch, planning.perch_request_value, planning.perch_plan_message, planning.perch_request_message,
               planning.perch_plan_value),
    ServiceRow("plan_powerline", PlanPowerline, planning.powerline_request_value, planning.powerline_plan_message,
               planning.powerline_request_message, planning.powerline_plan_value),
    ServiceRow("set_controller", SetController, flight.set_controller_request_value, flight.set_controller_response_message),
    ServiceRow("abort", Trigger, flight.trigger_request_value, flight.trigger_response_message),
    ServiceRow("depart", Trigger, flight.trigger_request_value, flight.trigger_response_message),
)


@dataclass(frozen=True)
class ActionRow:
    """Row of an action: its type, goal to value, feedback and result to messages, and the reason of a rejection to a result."""

    channel: str
    type: Any
    goal_value: Convert
    feedback_message: Convert
    result_message: Convert
    rejected: Convert


ACTIONS = (ActionRow("perch", Perch, mission.goal_value, mission.feedback_message, mission.result_message, mission.rejected),)


@lru_cache(maxsize=None)
def topic(channel: str) -> Topic:
    """Return the row of a channel.

    Raises:
        PerchError: there is no such channel.
    """
    parts = channel.split("/")
    for row in TOPICS:
        pattern = row.channel.split("/")
        if len(pattern) == len(parts) and all(w == p or (w.endswith("*") and p.startswith(w[:-1])) for w, p in zip(pattern, parts)):
            return row
    raise PerchError(f"no topic {channel!r} in perch_core.ros.topics")


def service(channel: str) -> ServiceRow:
    """Return the row of a service."""
    return next(row for row in SERVICES if row.channel == channel)


def action(channel: str) -> ActionRow:
    """Return the row of an action."""
    return next(row for row in ACTIONS if row.channel == channel)


def message_type(channel: str) -> Any:
    """Return the message type of a channel."""
    return topic(channel).message


def encode(channel: str, value: Any) -> bytes:
    """Serialise a value as a message of its channel."""
    row = topic(channel)
    message = row.to_message(value)
    data: bytes = message if row.packed else serialize_message(message)
    return data


def decode(channel: str, data: bytes) -> Any:
    """Return the value of a serialised message; the first one if it has several (`/tf`).

    Raises:
        PerchError: the message cannot be converted.
    """
    row = topic(channel)
    value = row.read(data)
    if isinstance(value, list):
        if not value:
            raise PerchError(f"{channel}: the message is empty")
        return value[0]
    return value


_BEGIN = struct.Struct("<iI")  # of a stamp, after four bytes of encapsulation


def stamp_of(message: Any, data: bytes) -> int:
    """Return the stamp of a serialised message that begins with a header or is a clock [ns]; 0 for other messages.

    Raises:
        PerchError: the message ends before its stamp.
    """
    if message is Clock or hasattr(message, "header"):
        if len(data) < 4 + _BEGIN.size:
            raise PerchError(f"not a whole {message.__name__}: {len(data)} bytes")
        sec, nanosec = _BEGIN.unpack_from(data, 4)
        return int(sec * NANOSECONDS + nanosec)
    return 0


__all__ = ["ACTIONS", "SERVICES", "TOPICS", "Diagnostics", "Topic", "action", "decode", "encode", "message_type", "service", "stamp_of", "topic"]
