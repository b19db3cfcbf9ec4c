"""The scripts' connection to the ROS graph."""

from __future__ import annotations

import pytest

pytest.importorskip("rclpy")

from ros_graph.connection import connect  # noqa: E402


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
