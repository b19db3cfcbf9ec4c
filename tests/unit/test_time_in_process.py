"""Simulation time between nodes of one process."""

import time
from itertools import pairwise
from types import SimpleNamespace

import pytest

rclpy = pytest.importorskip("rclpy")

from builtin_interfaces.msg import Time  # noqa: E402
from perch_core.component import Component, Output, Timer  # noqa: E402
from perch_core.ros.arrival import ArrivalNode  # noqa: E402
from perch_core.ros.node import close_nodes, connect  # noqa: E402
from perch_core.ros.wiring import Wiring  # noqa: E402
from rclpy.experimental import EventsExecutor  # noqa: E402
from rclpy.node import Node  # noqa: E402
from rclpy.parameter import Parameter  # noqa: E402
from rosgraph_msgs.msg import Clock  # noqa: E402
from unit.test_requests_of_nodes import Nothing, until  # noqa: E402


class Ticking(Component[Nothing]):
    """Has a clock."""

    config_type = Nothing
    clock = Output(int, "/clock")


class Listening(Component[Nothing]):
    """Has none."""

    config_type = Nothing


class Waking(Component[Nothing]):
    """Keeps the times of its timers."""

    config_type = Nothing
    wake, stamp = Timer(0.005), Timer(0.005, stamping=True)

    def __init__(self, config):
        super().__init__(config)
        self.times, self.stamps = [], []

    def on_wake(self, now):
        """Keep it."""
        self.times.append(now)

    def on_stamp(self, now):
        """Keep it."""
        self.stamps.append(now)


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


def test_a_negative_time_is_ignored_and_other_clocks_are_named(context, monkeypatch):
    """rclpy would raise an exception in the executor, and the process would end."""
    simulated = [Parameter("use_sim_time", value=True)]
    listening = ArrivalNode("listening", Listening, Wiring(), context=context, parameter_overrides=simulated)
    ticking = ArrivalNode("ticking", Ticking, Wiring(), context=context)
    foreign, executor = Node("foreign", context=context), EventsExecutor(context=context)
    clock = foreign.create_publisher(Clock, "/clock", 1)
    said = []
    monkeypatch.setattr(ticking, "warn_once", said.append)
    try:
        connect([listening, ticking], executor)
        end = time.monotonic() + 60.0
        while not (said and listening.get_clock().now().nanoseconds == 7_000_000_000):
            assert time.monotonic() < end
            for sec in (-5, 7):
                clock.publish(Clock(clock=Time(sec=sec)))
                executor.spin_once(timeout_sec=0.1)
        assert said[0] == "/clock: /foreign publishes it, too: the clocks of nodes in other processes follow both"
    finally:
        executor.shutdown()
        foreign.destroy_node()
        close_nodes([listening, ticking])


@pytest.mark.parametrize("step", [10_000_000_000, -5_000_000_000])
def test_the_time_of_timers_goes_on_where_the_clock_is_set(executor, monkeypatch, step):
    node = ArrivalNode("waking", Waking, Wiring(), context=executor.context)
    waking, right, wrong_by = node.component, node.host_time, [0]
    monkeypatch.setattr(node, "host_time", lambda: right() + wrong_by[0])
    node.connect()
    executor.add_node(node)
    until(executor, lambda: waking.times and waking.stamps)
    wrong_by[0] = step
    counted = len(waking.times), len(waking.stamps)
    until(executor, lambda: len(waking.times) > counted[0] + 4 and len(waking.stamps) > counted[1] + 4)
    elapsed = [after - before for before, after in pairwise(waking.times)]
    assert min(elapsed) >= 0 and sum(elapsed) < 4_000_000_000
    assert max(abs(after - before) for before, after in pairwise(waking.stamps)) > 4_000_000_000


def test_without_simulation_time_on_the_clock_the_time_of_timers_goes_on(executor):
    node = ArrivalNode("waking", Waking, Wiring(), context=executor.context, parameter_overrides=[Parameter("use_sim_time", value=True)])
    node.connect()
    executor.add_node(node)
    until(executor, lambda: len(node.component.times) > 10)
    assert node.component.times[-1] - node.component.times[0] > 20_000_000 and set(node.component.stamps) == {0}


def test_a_late_call_of_a_timer_has_the_time_at_which_it_was_due(executor, monkeypatch):
    node, made = ArrivalNode("waking", Waking, Wiring(), context=executor.context), []

    def create_timer(period, callback, clock):
        made.append(SimpleNamespace(callback=callback, timer_period_ns=round(1e9 * period), time_until_next_call=lambda: 5_000_000 - late))
        return made[-1]

    monkeypatch.setattr(node, "create_timer", create_timer)
    node.connect()
    begin = time.monotonic_ns()
    for k, late in enumerate((0, 1_700_000, 4_900_000, 20_000)):
        monkeypatch.setattr(time, "monotonic_ns", lambda: begin + 5_000_000 * k + late)
        made[0].callback()
    assert [after - before for before, after in pairwise(node.component.times)] == [5_000_000] * 3
