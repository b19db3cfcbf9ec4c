"""Messages to YAML and back, as the graph scripts show and read them."""

from __future__ import annotations

import math

import numpy as np
import pytest
import yaml
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import Point, PoseWithCovarianceStamped
from hypothesis import given
from hypothesis import strategies as st
from perch_core.errors import ConfigError
from perch_msgs.msg import ControllerCommand, MotorCommand, Trajectory
from ros_graph.commands import GraphError
from ros_graph.connection import GraphConnection
from ros_graph.messages import fill, interface, parse, pick, to_yaml
from ros_graph.topics import rate_summary
from sensor_msgs.msg import Image, Imu
from std_msgs.msg import String

NUMBERS = st.floats(allow_nan=False, allow_infinity=False)


@given(NUMBERS, NUMBERS, st.text(max_size=20))
def test_what_is_shown_can_be_read_back(x, y, text):
    message = Imu()
    message.header.frame_id = text
    message.linear_acceleration.x, message.orientation_covariance[4] = x, y
    shown = to_yaml(message)
    assert fill(Imu(), parse(shown, "message")) == message


def test_arrays_of_messages_can_be_read_back():
    text = "{header: {frame_id: map}, segments: [{duration: 1, x: [0, 1.5]}, {duration: 2.5}]}"
    message = fill(Trajectory(), parse(text, "message"))
    assert [s.duration for s in message.segments] == [1.0, 2.5] and list(message.segments[0].x) == [0.0, 1.5]
    assert fill(Trajectory(), parse(to_yaml(message), "message")) == message


def test_long_things_are_cut():
    image = Image(data=bytes(200))
    assert len(yaml.safe_load(to_yaml(image))["data"]) == 129
    assert "length: 200" in yaml.safe_load(to_yaml(image, arrays=False))["data"]
    assert yaml.safe_load(to_yaml(String(data="a" * 200)))["data"] == "a" * 128 + "..."


def test_octets_are_numbers():
    message = fill(DiagnosticStatus(), parse("{level: 2}", "message"))
    assert message.level == DiagnosticStatus.ERROR and yaml.safe_load(to_yaml(message))["level"] == 2
    assert to_yaml(pick(message, "level")) == "2\n"


@pytest.mark.parametrize("name", ["", "/", "/a//b", "/a/", "/1a", "/bad-name", "/odometry "])
def test_names_that_ros_refuses_are_refused_in_one_line(name):
    with pytest.raises(GraphError, match="expected words of letters") as error:
        GraphConnection.absolute(None, name)
    assert len(str(error.value).splitlines()) == 1
    assert GraphConnection.absolute(None, "quad1/odometry") == "/quad1/odometry"


def test_parts_of_messages():
    message = PoseWithCovarianceStamped()
    message.pose.pose.position.x = 1.5
    message.pose.covariance[7] = 2.5
    assert to_yaml(pick(message, "pose.pose.position.x")) == "1.5\n"
    assert to_yaml(pick(message, "pose.covariance[7]")) == "2.5\n"
    with pytest.raises(GraphError, match="'pos' does not exist; there are: pose, covariance"):
        pick(message, "pose.pos")
    with pytest.raises(GraphError, match=r"\[36\] does not exist"):
        pick(message, "pose.covariance[36]")


@pytest.mark.parametrize("text, words", [
    ("{x: [1]}", "x: .1. does not fit double"),
    ("{x: true}", "does not fit double"),
    ("{w: 1}", "w: no such field; there are: x, y, z"),
    ("[1]", "expected fields"),
    ("[]", "expected fields"),
    ("0", "expected fields"),
    ("{x: 1", "not valid YAML"),
])
def test_values_that_do_not_fit_are_refused(text, words):
    with pytest.raises((GraphError, ConfigError), match=words):
        fill(Point(), parse(text, "message"))


def test_fixed_arrays_need_their_length():
    assert list(fill(MotorCommand(), {"rotor_speed": [1, 2, 3, 4]}).rotor_speed) == [1.0, 2.0, 3.0, 4.0]
    with pytest.raises(GraphError, match="does not fit"):
        fill(MotorCommand(), {"rotor_speed": [1, 2, 3]})
    with pytest.raises(GraphError, match="does not fit"):
        fill(MotorCommand(), {"armed": 1})


@pytest.mark.parametrize("value", [-1, 256, 258, 1 << 70, -(1 << 70)])
def test_integers_beyond_their_type_are_refused(value):
    with pytest.raises(GraphError, match="does not fit uint8"):
        fill(ControllerCommand(), {"command": value})
    assert fill(ControllerCommand(), {"command": 5}).command == 5


def test_numbers_that_yaml_takes_for_text_are_numbers():
    # YAML 1.1 reads 1e-5 as a string; a float field does not care
    assert fill(Point(), parse("{x: 1e-5, y: .nan, z: .inf}", "message")).x == 1e-5


def test_types_by_name():
    assert interface("std_msgs/msg/String", "msg") is interface("std_msgs/String", "msg") is String
    for name in ("std_msgs", "std_msgs/msg/Strin", "no_msgs/msg/A", "std_srvs/srv/Trigger", "./msg/String", "std_msgs/msg/_string"):
        with pytest.raises(GraphError, match="type "):
            interface(name, "msg")


def test_rates():
    text = rate_summary([0.0, 0.1, 0.2, 0.4])
    assert "average rate: 7.500" in text and "min: 0.100s max: 0.200s" in text and "window: 4" in text
    assert math.isclose(float(text.split("std dev: ")[1].split("s")[0]), np.std([0.1, 0.1, 0.2]), abs_tol=1e-5)
    assert "one message" in rate_summary([1.0])
