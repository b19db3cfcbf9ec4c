"""Every channel's value survives its way through the message and back to the last bit; fast messages are those of rclpy."""

import importlib
from types import SimpleNamespace

import numpy as np
import pytest
from perch_core.component import Action, Client, Component, Input, Output, Service, ports
from perch_core.errors import PerchError
from perch_core.ros import topics
from perch_core.ros.arrival import ArrivalNode
from perch_core.ros.goal_server import ServedGoal
from perch_core.ros.intake import Intake
from perch_core.ros.messages.sensing import imu_value
from perch_core.ros.wiring import Wiring
from perch_core.values import AttitudeThrust, ControllerCommand, ImuSample, InertialState, MotorCommand, OdometryState, RatesThrust, RotorState
from perch_msgs.action import Perch
from perch_sim.scenario import NODES
from unit.rclpy_messages import message_of
from unit.test_requests_of_nodes import Nothing, until
from rclpy.qos import HistoryPolicy
from rclpy.serialization import deserialize_message, serialize_message

RNG = np.random.default_rng(3)


def _floats(n):
    return tuple(RNG.standard_normal(n).tolist())


def _odometry(frame="map"):
    return OdometryState(5_000_000_123, _floats(3), _floats(4), _floats(3), _floats(3), RNG.standard_normal((6, 6)), RNG.standard_normal((6, 6)), frame)


FAST = [("imu/data_raw", ImuSample(1_234_567_891, _floats(3), _floats(3), frame)) for frame in ("imu_link", "", "a", "abcdefgh")]
FAST += [("odometry", _odometry(frame)) for frame in ("map", "odom", "x")]
FAST += [("vio/state", InertialState(1_234_567_891, *(RNG.standard_normal(n) for n in (3, 4, 3, 3, 3)), RNG.standard_normal((15, 15))))]
FAST += [("motor_command", MotorCommand(77, armed, _floats(4))) for armed in (True, False)]
FAST += [("rates_thrust_command", RatesThrust(77, armed, _floats(3), 9.5)) for armed in (True, False)]
FAST += [("attitude_thrust_command", AttitudeThrust(77, armed, _floats(4), _floats(3), 9.5)) for armed in (True, False)]
FAST += [("rotor_state", RotorState(1_234_567_891, _floats(4), _floats(4)))]


def same(a, b):
    """Equal to the last bit."""
    if isinstance(a, np.ndarray):
        return np.array_equal(a, b)
    if isinstance(a, tuple):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b))
    return a == b


@pytest.mark.parametrize("channel, value", FAST)
def test_fast_messages_are_those_of_rclpy(channel, value):
    row = topics.topic(channel)
    by_rclpy = serialize_message(message_of(value))
    assert deserialize_message(row.to_message(value), row.message) == deserialize_message(by_rclpy, row.message)
    assert same(row.to_value(by_rclpy), value)
    assert same(topics.decode(channel, topics.encode(channel, value)), value)


@pytest.mark.parametrize("row", topics.TOPICS, ids=lambda row: row.channel)
def test_bytes_that_are_no_message_are_refused(row):
    for data in (b"", b"\0\1\0\0", b"\0\1\0\0\1\0"):
        with pytest.raises(PerchError):
            row.read(data)
        if "header" in row.message.get_fields_and_field_types():
            with pytest.raises(PerchError, match="not a whole"):
                topics.stamp_of(row.message, data)


@pytest.mark.parametrize("channel, value", FAST)
def test_a_message_that_is_cut_short_is_refused(channel, value):
    data = topics.encode(channel, value)
    for length in (0, 3, 5, 11, len(data) // 2):
        with pytest.raises(PerchError):
            topics.decode(channel, data[:length])


@pytest.mark.parametrize("channel, value, spoil, words", [
    ("imu/data_raw", FAST[0][1], lambda msg: msg.angular_velocity_covariance.__setitem__(0, -1.0), "no angular velocity"),
    ("imu/data_raw", FAST[0][1], lambda msg: msg.linear_acceleration_covariance.__setitem__(0, -1.0), "no acceleration"),
    ("odometry", _odometry(), lambda msg: setattr(msg, "child_frame_id", "odom"), "'odom'"),
    ("vio/odometry", _odometry(), lambda msg: setattr(msg, "child_frame_id", "camera_link"), "'camera_link'")])
def test_what_a_message_does_not_hold_is_not_read_of_it(channel, value, spoil, words):
    msg = message_of(value)
    spoil(msg)
    if isinstance(value, ImuSample):  # as in bags
        with pytest.raises(PerchError, match=words):
            imu_value(msg)
    with pytest.raises(PerchError, match=words):
        topics.decode(channel, serialize_message(msg))


@pytest.mark.parametrize("field, size", [("v_WB", 2), ("p_WB", 4), ("covariance", 36)])
def test_a_state_of_other_sizes_is_not_written(field, size):
    state = next(value for channel, value in FAST if channel == "vio/state")
    with pytest.raises(ValueError):
        topics.encode("vio/state", state._replace(**{field: np.zeros(size)}))


def test_a_time_is_one_message_for_all_nodes_of_a_process():
    to_message = topics.topic("/clock").to_message
    assert to_message(5_000_000_123) is to_message(5_000_000_123)
    assert [topics.topic("/clock").to_value(to_message(stamp)) for stamp in (7, 5_000_000_123, 7)] == [7, 5_000_000_123, 7]


def test_cameras_share_a_row():
    assert topics.topic("camera_front/image_raw") is topics.topic("camera_down/image_raw")
    assert topics.topic("camera_front/image_raw/compressed").message.__name__ == "CompressedImage"
    with pytest.raises(PerchError):
        topics.topic("no/such/topic")


@pytest.mark.parametrize("name", NODES)
def test_every_port_of_every_node_has_its_row(name):
    """What a message is and how it becomes a value is found in the table, and the table says it once."""
    component = importlib.import_module(f"{NODES[name]}.{name}_node").NODE.component
    stand_in = SimpleNamespace(config=component.config_type())
    rows = {Input: topics.topic, Output: topics.topic, Service: topics.service, Client: topics.service, Action: topics.action}
    for kind, row in rows.items():
        for port in ports(component, kind):
            if port not in (Component.log, Component.diagnostics):
                assert row(port.channel(stand_in)), port.name


@pytest.mark.parametrize("rows", [topics.TOPICS, topics.SERVICES, topics.ACTIONS])
def test_no_channel_has_two_rows(rows):
    channels = [row.channel for row in rows]
    assert len(set(channels)) == len(channels)


def test_a_goal_that_is_rejected_has_not_perched():
    ends, results = [], []
    handle = SimpleNamespace(request=Perch.Goal(), abort=lambda: ends.append("aborted"))
    ServedGoal(SimpleNamespace(finish=lambda handle, result: results.append(result)), handle, topics.action("perch")).reject("busy")
    assert ends == ["aborted"] and (results[0].success, results[0].error_code, results[0].message) == (False, Perch.Result.BAD_GOAL, "busy")


def test_an_observer_refuses_bytes_that_are_no_message_and_goes_on():
    refused, seen = [], []
    intake = Intake(SimpleNamespace(wiring=None, log_refusal=lambda channel, error: refused.append((channel, error))))
    row = topics.topic("odometry")
    for data in (b"\0\1\0\0", topics.encode("odometry", _odometry())):
        intake._receive_raw(row, "odometry", "/odometry", seen.append, data)
    assert [value.stamp for value in seen] == [5_000_000_123] and [channel for channel, _ in refused] == ["odometry"]


@pytest.mark.parametrize("channel", ["controller/command", "trajectory", "recovery"])
def test_the_queue_of_an_order_holds_all_that_is_read_in_a_second(channel):
    row = topics.topic(channel)
    assert row.rate_max and all(one.history is HistoryPolicy.KEEP_ALL or one.depth >= row.rate_max for one in row.qos)


class Commanded(Component[Nothing]):
    """Keeps its commands."""

    config_type = Nothing
    command = Input(ControllerCommand, "controller/command")

    def on_command(self, command: ControllerCommand) -> None:
        """Keep it."""
        self.reasons = [*getattr(self, "reasons", []), command.reason]


def test_no_command_is_lost_while_the_controller_is_busy(executor):
    controller, row = ArrivalNode("commanded", Commanded, Wiring(), context=executor.context), topics.topic("controller/command")
    controller.connect()
    executor.add_node(controller)
    publisher = controller.create_publisher(row.message, row.channel, row.qos.publish)
    until(executor, publisher.get_subscription_count)
    sent = [str(k) for k in range(200)]
    for reason in sent:  # nobody reads them meanwhile
        publisher.publish(row.to_message(ControllerCommand(1, 1, reason)))
    until(executor, lambda: sent[-1] in getattr(controller.component, "reasons", []))
    assert controller.component.reasons == sent
