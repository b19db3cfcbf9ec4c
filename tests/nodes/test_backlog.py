"""Messages that wait until a node takes them."""

import os
import time
from dataclasses import dataclass

import pytest
import rclpy
from perch_msgs.msg import MotorCommand, Step
from rclpy.context import Context
from rclpy.experimental import EventsExecutor
from rclpy.node import Node

from perch_core.ros import qos
from perch_core.ros.conversions import to_stamp
from perch_core.ros.lockstep import Participant
from perch_core.ros.node import PerchNode
from perch_core.ros.wire import stamp_of
from perch_core.timing import CONTROL_PERIOD_NS as PERIOD


@dataclass(frozen=True)
class NoParameters:
    """None."""


class Graph:
    """A vehicle and a node under test in one process."""

    def __init__(self):
        self.context = Context()
        rclpy.init(context=self.context, domain_id=int(os.environ["ROS_DOMAIN_ID"]))
        self.vehicle = Node("v", context=self.context)
        self.node = PerchNode("under_test", NoParameters, context=self.context)
        self.chain = self.vehicle.create_publisher(MotorCommand, "chain", qos.CHAIN)
        self.steps = self.vehicle.create_publisher(Step, "step", qos.STEP)
        self.executor = EventsExecutor(context=self.context)
        self.executor.add_node(self.vehicle)

    def begin(self):
        self.executor.add_node(self.node)
        self.until(lambda: self.chain.get_subscription_count() == 1)

    def until(self, done):
        last = time.monotonic() + 10.0
        while not done():
            assert time.monotonic() < last, "did not happen"
            self.executor.spin_once(timeout_sec=0.01)

    def link(self, index):
        msg = MotorCommand()
        msg.header.stamp = to_stamp(index * PERIOD)
        self.chain.publish(msg)

    def close(self):
        self.executor.shutdown()
        self.vehicle.destroy_node()
        self.node.destroy_node()
        self.context.try_shutdown()


@pytest.fixture
def graph(ros_domain):
    out = Graph()
    yield out
    out.close()


def test_messages_wait_in_order_up_to_the_depth_of_the_topic(graph):
    backlog = graph.node.create_backlog(MotorCommand, "chain", qos.CHAIN)
    graph.begin()
    assert backlog.take() == []
    for k in range(qos.CHAIN.depth + 20):
        graph.link(k)
    taken = []
    graph.until(lambda: taken.extend(backlog.take()) or stamp_of(taken[-1]) == (qos.CHAIN.depth + 19) * PERIOD)
    assert [stamp_of(data) // PERIOD for data in taken][-qos.CHAIN.depth:] == list(range(20, qos.CHAIN.depth + 20))
    assert backlog.take() == []


def test_the_executor_is_not_woken(graph):
    """With the default executor loop the node's only events would be these messages."""
    graph.node.create_backlog(MotorCommand, "chain", qos.CHAIN)
    watched = {subscription.topic_name for subscription in graph.node.subscriptions}
    assert "/chain" not in watched
    graph.node.create_subscription(MotorCommand, "chain", lambda _: None, qos.CHAIN)
    assert "/chain" in {subscription.topic_name for subscription in graph.node.subscriptions}


@pytest.mark.parametrize("step_first", [False, True])
def test_a_step_is_handled_whichever_comes_first(graph, step_first):
    seen = []
    side = Participant(graph.node)
    side.chain(MotorCommand, "chain", lambda data: seen.append(stamp_of(data) // PERIOD), raw=True, backlog=True)
    graph.begin()
    graph.until(lambda: graph.steps.get_subscription_count() == 1)
    for k in range(3):
        first, second = (graph.steps.publish, graph.link) if step_first else (graph.link, graph.steps.publish)
        step = Step(stamp=to_stamp(k * PERIOD), index=k, lockstep=True)
        first(step if step_first else k)
        for _ in range(3):
            graph.executor.spin_once(timeout_sec=0.01)
        second(k if step_first else step)
        graph.until(lambda: seen == list(range(k + 1)))
