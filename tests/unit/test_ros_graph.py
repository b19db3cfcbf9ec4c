"""The scripts' connection to the ROS graph."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

pytest.importorskip("rclpy")

from ros_graph.commands import GraphError  # noqa: E402
from ros_graph.connection import connect  # noqa: E402
from ros_graph.topics import echo, show_info  # noqa: E402


def test_an_observation_is_settled_once_the_whole_graph_is(ros_domain, monkeypatch):
    """On a busy machine a topic may stay as it is for a while although its last endpoints are still to be discovered."""
    checks = 0

    def nodes():
        nonlocal checks
        checks += 1
        return {f"/node_{min(checks, 60)}"}

    with connect() as graph:
        monkeypatch.setattr(graph, "nodes", nodes)
        assert graph.settle(lambda: ["one"] if checks < 60 else ["one", "two"], 600.0) == ["one", "two"]


def test_a_topic_of_several_types_is_described_with_all_and_echoed_once_one_is_named(ros_domain, capfd):
    from std_msgs.msg import Float64, String

    arguments = SimpleNamespace(topic="x", type=None, spin_time=60.0, verbose=False, once=True, field="data", no_arr=False, n=None)
    with connect() as other, connect() as graph:  # a participant of Fast DDS has topics of one type each
        publishers = [other.node.create_publisher(Float64, "/x", 1), graph.node.create_publisher(String, "/x", 1)]
        graph.spin_until(lambda: graph.node.count_publishers("/x") == len(publishers), 60.0)
        assert show_info(graph, arguments) == 0
        assert "Type: std_msgs/msg/Float64, std_msgs/msg/String\n" in capfd.readouterr().out
        with pytest.raises(GraphError, match="topic /x has several types: .*; name one after the topic"):
            echo(graph, arguments)
