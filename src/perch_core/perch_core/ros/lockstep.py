"""Lockstep for every node but the vehicle: who sees which message at which step. See docs/architecture.md, "Lockstep".

Three kinds of topics:

* **chain** topics carry one message per step (or per n-th step) with the step's own stamp: imu/data_raw, odometry,
  motor_command, controller/status. A step is handled when its chain messages are there.
* **gated** topics carry results of slow participants. A message counts from the step whose `released` names it.
* everything else is delivered on arrival and must not influence the flight.

At start each slow participant greets the vehicle with an empty report that lists its gated topics (counts 0); the vehicle
waits for all greetings and names those topics in the first step. A gated subscription whose topic no participant has
announced (its node is not part of this run) passes messages through on arrival.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Any, Callable

from builtin_interfaces.msg import Time
from perch_msgs.msg import Release, Step, StepReport
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message

from perch_core.ros import qos
from perch_core.ros.backlog import Backlog
from perch_core.ros.composition import composition
from perch_core.ros.conversions import to_stamp
from perch_core.ros.priority import priority
from perch_core.ros.wire import StepReading, read_step, stamp_of
from perch_core.timing import TICK_STEPS

RETRY = 0.005  # [s] wall clock


class GatedPublisher:
    """A publisher that counts what it has published, for the step report."""

    def __init__(self, publisher: Publisher) -> None:
        self._publisher = publisher
        self.topic = publisher.topic_name
        self.count = 0

    def publish(self, msg: Any) -> None:
        """Publish; consumers see the message once the vehicle has released it."""
        self.count += 1
        self._publisher.publish(msg)


@dataclass
class _Gated:
    callback: Callable[[Any], None]
    inbox: deque = field(default_factory=deque)
    received: int = 0
    released: int = 0
    announced: bool = False


@dataclass
class _Chain:
    msg_type: type
    callback: Callable[[Any], None]
    period: int
    raw: bool
    on_arrival: Callable[[bytes], None] | None
    backlog: Backlog | None = None
    inbox: dict[int, bytes] = field(default_factory=dict)  # stamp -> serialised message, in order

    def deliver(self, data: bytes) -> None:
        self.callback(data if self.raw else deserialize_message(data, self.msg_type))


class Participant:
    """A node's side of the lockstep. Nothing here blocks; in real time messages are delivered on arrival."""

    def __init__(self, node: Node, on_step: Callable[[StepReading], None] | None = None, every: int = 1) -> None:
        """
        Args:
            node: the node that takes part.
            on_step: called at each step, after the released messages and before the chain messages of that step.
            every: steps that the node handles: 1, all of them; `TICK_STEPS`, those whose index it divides. A message
                costs every subscriber 0.1 ms of processor time, whether or not it is used.

        Raises:
            ValueError: another `every`.
        """
        if every not in (1, TICK_STEPS):
            raise ValueError(f"every {every} is neither 1 nor {TICK_STEPS}")
        self._node, self._on_step, self._every = node, on_step, every
        self._gated: dict[str, _Gated] = {}
        self._chains: list[_Chain] = []
        self._publishers: list[GatedPublisher] = []
        self._steps: deque[StepReading] = deque()
        self._busy = False
        self.lockstep: bool | None = None      # unknown until the first step
        self.step: StepReading | None = None   # the step handled last
        self._reports: Publisher | None = None
        self._greeting = self._retry = None
        composition.subscription(node, Step, "step" if every == 1 else "tick", self._receive_step, qos.STEP)

    # -- wiring ------------------------------------------------------------------------------------------------------

    def subscribe(self, msg_type: type, topic: str, callback: Callable[[Any], None],
                  profile: QoSProfile = qos.GATED) -> None:
        """Subscribe to a gated topic."""
        gated = _Gated(callback)
        subscription = self._node.create_subscription(
            msg_type, topic, lambda msg: self._receive_gated(gated, msg), profile)
        self._gated[subscription.topic_name] = gated

    def chain(self, msg_type: type, topic: str, callback: Callable[[Any], None], period: int = 1, raw: bool = False,
              on_arrival: Callable[[bytes], None] | None = None, backlog: bool = False) -> None:
        """Subscribe to a topic that carries one message with the step's stamp at every `period`-th step.

        Args:
            msg_type: of the topic; begins with a stamp or a header.
            topic: its name.
            callback: receives, at a step that is handled, its message; with period 1 those of the steps before it that
                were not handled come first.
            period: steps from one message that is wanted to the next.
            raw: give the message to the callback as it is on the wire (`perch_core.ros.wire` reads it).
            on_arrival: receives every serialised message as it comes, before its step is handled.
            backlog: the node is not woken by the messages; they are taken when a step or another message has woken it.
                For topics whose messages are sent before their step, or before another message of it. The node is a
                `PerchNode`.
        """
        chain = _Chain(msg_type, callback, period, raw, on_arrival)
        self._chains.append(chain)
        if backlog:
            chain.backlog = self._node.create_backlog(msg_type, topic, qos.CHAIN)
            if self._retry is None:  # a middleware may deliver in another order than was sent
                self._retry = self._node.create_timer(RETRY, self._advance, clock=Clock(clock_type=ClockType.STEADY_TIME))
                self._retry.cancel()
        else:
            composition.subscription(self._node, msg_type, topic, lambda data: self._receive_chain(chain, data), qos.CHAIN)

    def publisher(self, msg_type: type, topic: str, profile: QoSProfile = qos.GATED) -> GatedPublisher:
        """A publisher on a gated topic. Only slow participants, which send reports, have these."""
        gated = GatedPublisher(self._node.create_publisher(msg_type, topic, profile))
        self._publishers.append(gated)
        return gated

    def greet(self) -> None:
        """Call once, after all `publisher` calls, in a slow participant: announce it to the vehicle until a step comes."""
        self._reports = self._node.create_publisher(StepReport, "step_report", qos.GATED)
        self.report(Time())
        self._greeting = self._node.create_timer(0.2, self._repeat_greeting)

    def report(self, trigger: Time | int) -> None:
        """Tell the vehicle that the work which the image or tick with stamp `trigger` started is finished and published."""
        self._reports.publish(StepReport(
            node=self._node.get_name(), trigger=to_stamp(trigger) if isinstance(trigger, int) else trigger,
            published=[Release(topic=p.topic, count=p.count) for p in self._publishers]))

    def later(self, work: Callable[[], None]) -> None:
        """Do what the control loop does not wait for: in real time after the step's command, in lockstep at once, as it belongs
        to the step."""
        if self.lockstep is False:
            composition.later(work)
        else:
            work()

    def in_spare_time(self, work: Callable[[], None]) -> None:
        """As `later`, but in real time in a step that leaves time for it."""
        if self.lockstep is False:
            composition.in_spare_time(work)
        else:
            work()

    def _repeat_greeting(self) -> None:
        if self.lockstep is None:
            self.report(Time())
        elif self._greeting is not None:
            self._greeting.cancel()

    # -- arrivals ----------------------------------------------------------------------------------------------------

    def _receive_step(self, data: bytes) -> None:
        step = read_step(data)
        if self.lockstep is None:
            self.lockstep = step.lockstep
            if not step.lockstep:
                self._begin_real_time()
            elif self._every == TICK_STEPS:
                priority.give_way()
        if step.lockstep:
            self._steps.append(step)
            self._advance()
        else:
            self.step = step
            if self._on_step is not None:
                self._on_step(step)
            self._take_backlogs()

    def _receive_gated(self, gated: _Gated, msg: Any) -> None:
        gated.received += 1
        if self.lockstep is False or (self.lockstep and not gated.announced):
            gated.callback(msg)
            return
        gated.inbox.append(msg)
        self._advance()

    def _receive_chain(self, chain: _Chain, data: bytes) -> None:
        self._keep(chain, data)
        if self._steps:
            self._advance()

    def _keep(self, chain: _Chain, data: bytes) -> None:
        if chain.on_arrival is not None:
            chain.on_arrival(data)
        if self.lockstep is False:
            chain.deliver(data)
        else:
            chain.inbox[stamp_of(data)] = data

    def _take_backlogs(self) -> None:
        for chain in self._chains:
            if chain.backlog is not None:
                for data in chain.backlog.take():
                    self._keep(chain, data)

    def _begin_real_time(self) -> None:
        """Ask for real-time scheduling where every step has a deadline, and deliver what came before the first step."""
        problem = priority.ask() if self._every == 1 else ""
        if problem:
            self._node.get_logger().warning(problem)
        for gated in self._gated.values():
            while gated.inbox:
                gated.callback(gated.inbox.popleft())
        for chain in self._chains:
            for key in sorted(chain.inbox):
                chain.deliver(chain.inbox.pop(key))

    # -- steps -------------------------------------------------------------------------------------------------------

    def _advance(self) -> None:
        """Handle every step whose messages are all here."""
        if self._busy:
            return  # a callback published to this very process (composed): the outer call goes on
        self._busy = True
        try:
            while self._steps:
                self._take_backlogs()
                if not self._ready(self._steps[0]):
                    break
                self._handle(self._steps.popleft())
        finally:
            self._busy = False
        if self._retry is not None and self._retry.is_canceled() != (not self._steps):
            self._retry.reset() if self._steps else self._retry.cancel()

    def _ready(self, step: StepReading) -> bool:
        for topic, count in step.released:
            gated = self._gated.get(topic)
            if gated is not None:
                gated.announced = True
                gated.released = max(gated.released, count)
        return all(g.received >= g.released for g in self._gated.values() if g.announced) and all(
            step.stamp in c.inbox for c in self._chains if step.index % c.period == 0)

    def _handle(self, step: StepReading) -> None:
        self.step = step
        for topic in sorted(self._gated):
            gated = self._gated[topic]
            keep = gated.received - gated.released if gated.announced else 0
            while len(gated.inbox) > keep:
                gated.callback(gated.inbox.popleft())
        if self._on_step is not None:
            self._on_step(step)
        for chain in self._chains:
            for stamp in [stamp for stamp in chain.inbox if stamp <= step.stamp]:
                data = chain.inbox.pop(stamp)
                if chain.period == 1 or (stamp == step.stamp and step.index % chain.period == 0):
                    chain.deliver(data)
