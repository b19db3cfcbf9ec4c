"""Simulation time between nodes of one process."""

from dataclasses import dataclass

import pytest

rclpy = pytest.importorskip("rclpy")

from perch_core.component import Component, Output  # noqa: E402
from perch_core.ros.arrival import ArrivalNode  # noqa: E402
from perch_core.ros.node import close_nodes  # noqa: E402
from perch_core.ros.wiring import Wiring  # noqa: E402
from rclpy.parameter import Parameter  # noqa: E402


@dataclass(frozen=True)
class Nothing:
    """No parameters."""


class Ticking(Component[Nothing]):
    """Has a clock."""

    config_type = Nothing
    clock = Output(int, "/clock")


class Listening(Component[Nothing]):
    """Has none."""

    config_type = Nothing


@pytest.fixture
def context():
    context = rclpy.Context()
    rclpy.init(context=context)
    yield context
    rclpy.shutdown(context=context)


@pytest.mark.parametrize("together", [True, False])
def test_time_of_a_clock_in_the_process_is_known_at_once_and_without_a_subscription(context, together):
    wiring = Wiring()
    simulated = [Parameter("use_sim_time", value=True)]
    listening = ArrivalNode("listening", Listening, wiring, context=context, parameter_overrides=simulated)
    ticking = ArrivalNode("ticking", Ticking, wiring if together else Wiring(), context=context)
    try:
        listening.use_local_clock()
        topics = [subscription.topic_name for subscription in listening.subscriptions]
        ticking.component.clock(7_000_000_123)
        assert ("/clock" in topics) is not together
        assert listening.get_clock().now().nanoseconds == (7_000_000_123 if together else 0)
    finally:
        close_nodes([listening, ticking])
