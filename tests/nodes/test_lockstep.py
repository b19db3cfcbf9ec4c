"""The participant's side of the lockstep: what is delivered at which step, whatever the order of arrival."""

import os

import pytest
import rclpy
from perch_msgs.msg import ControllerCommand, MotorCommand, Release, Step, StepReport
from rclpy.context import Context
from rclpy.experimental import EventsExecutor
from rclpy.node import Node

from perch_core.ros import qos
from perch_core.ros.conversions import nanoseconds, to_stamp
from perch_core.ros.lockstep import Participant
from perch_core.ros.wire import stamp_of
from perch_core.timing import CONTROL_PERIOD_NS as PERIOD, TICK_STEPS


class Graph:
    """A vehicle, a slow producer and a consumer in one process."""

    def __init__(self):
        self.context = Context()
        rclpy.init(context=self.context, domain_id=int(os.environ["ROS_DOMAIN_ID"]))
        self.vehicle, self.producer, self.consumer = (Node(name, context=self.context) for name in ("v", "producer", "consumer"))
        self.steps = self.vehicle.create_publisher(Step, "step", qos.STEP)
        self.chain = self.vehicle.create_publisher(MotorCommand, "chain", qos.CHAIN)
        self.reports = []
        self.vehicle.create_subscription(StepReport, "step_report", self.reports.append, qos.GATED)
        self.slow = Participant(self.producer)
        self.results = self.slow.publisher(ControllerCommand, "result")
        self.seen = []
        self.fast = Participant(self.consumer, lambda step: self.seen.append(("step", step.index)))
        self.fast.subscribe(ControllerCommand, "result", lambda m: self.seen.append(("result", m.reason)))
        self.fast.subscribe(ControllerCommand, "stray", lambda m: self.seen.append(("stray", m.reason)))
        self.fast.chain(MotorCommand, "chain", lambda m: self.seen.append(("chain", nanoseconds(m.header.stamp) // PERIOD)))
        self.executor = EventsExecutor(context=self.context)
        for node in (self.vehicle, self.producer, self.consumer):
            self.executor.add_node(node)
        self.slow.greet()
        self.until(lambda: self.reports and self.steps.get_subscription_count() == 2 and self.chain.get_subscription_count() == 1)

    def until(self, done, spins=400):
        for _ in range(spins):
            if done():
                return
            self.executor.spin_once(timeout_sec=0.05)
        raise AssertionError("did not happen")

    def settle(self):
        for _ in range(20):
            self.executor.spin_once(timeout_sec=0.01)

    def step(self, index, released=(), lockstep=True):
        self.steps.publish(Step(stamp=to_stamp(index * PERIOD), index=index, lockstep=lockstep,
                                released=[Release(topic=t, count=c) for t, c in released]))

    def link(self, index):
        msg = MotorCommand()
        msg.header.stamp = to_stamp(index * PERIOD)
        self.chain.publish(msg)

    def close(self):
        self.executor.shutdown()
        for node in (self.vehicle, self.producer, self.consumer):
            node.destroy_node()
        self.context.try_shutdown()


@pytest.fixture
def graph(ros_domain):
    out = Graph()
    yield out
    out.close()


def test_a_greeting_announces_the_gated_topics(graph):
    assert graph.reports[0].node == "producer"
    assert [(r.topic, r.count) for r in graph.reports[0].published] == [("/result", 0)]


def test_results_count_from_the_step_that_releases_them(graph):
    graph.results.publish(ControllerCommand(reason="early"))
    graph.settle()
    for k in range(3):
        graph.step(k, [("/result", 0)] if k == 0 else ())
        graph.link(k)
    graph.step(3, [("/result", 1)])
    graph.link(3)
    graph.until(lambda: ("chain", 3) in graph.seen)
    assert graph.seen == [("step", 0), ("chain", 0), ("step", 1), ("chain", 1), ("step", 2), ("chain", 2),
                          ("result", "early"), ("step", 3), ("chain", 3)]


def test_a_step_waits_for_its_release_and_for_its_chain(graph):
    graph.step(0, [("/result", 0)])
    graph.link(0)
    graph.step(1, [("/result", 1)])
    graph.link(1)
    graph.settle()
    assert graph.seen == [("step", 0), ("chain", 0)]
    graph.results.publish(ControllerCommand(reason="late"))
    graph.until(lambda: ("chain", 1) in graph.seen)
    graph.step(2)
    graph.settle()
    assert ("step", 2) not in graph.seen
    graph.link(2)
    graph.until(lambda: ("chain", 2) in graph.seen)
    assert graph.seen[2:] == [("result", "late"), ("step", 1), ("chain", 1), ("step", 2), ("chain", 2)]


def test_topics_of_nodes_that_take_no_part_pass_through(graph):
    stray = graph.vehicle.create_publisher(ControllerCommand, "stray", qos.GATED)
    graph.step(0, [("/result", 0)])
    graph.link(0)
    graph.until(lambda: ("chain", 0) in graph.seen)
    graph.until(lambda: stray.get_subscription_count() == 1)
    stray.publish(ControllerCommand(reason="by hand"))
    graph.until(lambda: ("stray", "by hand") in graph.seen)


def test_real_time_delivers_on_arrival(graph):
    graph.results.publish(ControllerCommand(reason="before"))
    graph.settle()
    assert graph.seen == []
    graph.step(0, lockstep=False)
    graph.until(lambda: ("step", 0) in graph.seen)
    graph.results.publish(ControllerCommand(reason="after"))
    graph.until(lambda: ("result", "after") in graph.seen)
    assert graph.seen[0] == ("result", "before")


def test_a_report_carries_trigger_and_counts(graph):
    graph.results.publish(ControllerCommand())
    graph.slow.report(to_stamp(5 * PERIOD))
    graph.until(lambda: any(nanoseconds(r.trigger) == 5 * PERIOD for r in graph.reports))
    assert [(r.topic, r.count) for r in graph.reports[-1].published] == [("/result", 1)]


def test_a_node_of_ticks_gets_every_message_up_to_its_tick(graph):
    """The tick brings all chain messages since the last one, of a slower chain the one with its stamp, and all releases."""
    node = Node("ticking", context=graph.context)
    graph.executor.add_node(node)
    seen = []
    side = Participant(node, lambda tick: seen.append(("tick", tick.index)), every=TICK_STEPS)
    side.subscribe(ControllerCommand, "result", lambda m: seen.append(("result", m.reason)))
    side.chain(MotorCommand, "chain", lambda m: seen.append(nanoseconds(m.header.stamp) // PERIOD))
    side.chain(MotorCommand, "chain", lambda data: seen.append(("slow", stamp_of(data) // PERIOD)), TICK_STEPS, raw=True)
    ticks = graph.vehicle.create_publisher(Step, "tick", qos.STEP)
    graph.until(lambda: ticks.get_subscription_count() == 1 and graph.chain.get_subscription_count() == 3)
    for k in range(2 * TICK_STEPS):
        graph.link(k)
    graph.results.publish(ControllerCommand(reason="first"))
    graph.results.publish(ControllerCommand(reason="second"))
    for k, count in ((0, 0), (TICK_STEPS, 1)):
        ticks.publish(Step(stamp=to_stamp(k * PERIOD), index=k, lockstep=True, released=[Release(topic="/result", count=count)]))
    graph.until(lambda: ("slow", TICK_STEPS) in seen)
    graph.settle()
    assert seen == [("tick", 0), 0, ("slow", 0), ("result", "first"), ("tick", TICK_STEPS), *range(1, TICK_STEPS + 1),
                    ("slow", TICK_STEPS)]
    node.destroy_node()


def test_only_steps_and_ticks_can_be_asked_for(graph):
    with pytest.raises(ValueError, match="every 5 is neither 1 nor 10"):
        Participant(graph.consumer, every=5)
