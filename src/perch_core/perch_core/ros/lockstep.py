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
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile

from perch_core.ros import qos
from perch_core.ros.conversions import nanoseconds


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
    callback: Callable[[Any], None]
    period: int
    inbox: dict[int, Any] = field(default_factory=dict)


class Participant:
    """A node's side of the lockstep. Nothing here blocks; in real time messages are delivered on arrival."""

    def __init__(self, node: Node, on_step: Callable[[Step], None] | None = None) -> None:
        """
        Args:
            node: the node that takes part.
            on_step: called at each step, after the released messages and before the chain messages of that step.
        """
        self._node, self._on_step = node, on_step
        self._gated: dict[str, _Gated] = {}
        self._chains: list[_Chain] = []
        self._publishers: list[GatedPublisher] = []
        self._steps: deque[Step] = deque()
        self._busy = False
        self.lockstep: bool | None = None  # unknown until the first step
        self.step: Step | None = None      # the step handled last
        self._reports: Publisher | None = None
        self._greeting = None
        node.create_subscription(Step, "step", self._receive_step, qos.STEP)

    # -- wiring ------------------------------------------------------------------------------------------------------

    def subscribe(self, msg_type: type, topic: str, callback: Callable[[Any], None],
                  profile: QoSProfile = qos.GATED) -> None:
        """Subscribe to a gated topic."""
        gated = _Gated(callback)
        subscription = self._node.create_subscription(
            msg_type, topic, lambda msg: self._receive_gated(gated, msg), profile)
        self._gated[subscription.topic_name] = gated

    def chain(self, msg_type: type, topic: str, callback: Callable[[Any], None], period: int = 1,
              profile: QoSProfile = qos.CHAIN) -> None:
        """Subscribe to a topic that carries one message with the step's stamp at every `period`-th step."""
        chain = _Chain(callback, period)
        self._chains.append(chain)
        self._node.create_subscription(msg_type, topic, lambda msg: self._receive_chain(chain, msg), profile)

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

    def report(self, trigger: Time) -> None:
        """Tell the vehicle that the work which the image or tick with stamp `trigger` started is finished and published."""
        self._reports.publish(StepReport(
            node=self._node.get_name(), trigger=trigger,
            published=[Release(topic=p.topic, count=p.count) for p in self._publishers]))

    def _repeat_greeting(self) -> None:
        if self.lockstep is None:
            self.report(Time())
        elif self._greeting is not None:
            self._greeting.cancel()

    # -- arrivals ----------------------------------------------------------------------------------------------------

    def _receive_step(self, step: Step) -> None:
        if self.lockstep is None:
            self.lockstep = step.lockstep
            if not step.lockstep:
                self._flush()
        if step.lockstep:
            self._steps.append(step)
            self._advance()
        else:
            self.step = step
            if self._on_step is not None:
                self._on_step(step)

    def _receive_gated(self, gated: _Gated, msg: Any) -> None:
        gated.received += 1
        if self.lockstep is False or (self.lockstep and not gated.announced):
            gated.callback(msg)
            return
        gated.inbox.append(msg)
        self._advance()

    def _receive_chain(self, chain: _Chain, msg: Any) -> None:
        if self.lockstep is False:
            chain.callback(msg)
            return
        chain.inbox[nanoseconds(msg.header.stamp)] = msg
        self._advance()

    def _flush(self) -> None:
        """Real time: deliver what came before the first step."""
        for gated in self._gated.values():
            while gated.inbox:
                gated.callback(gated.inbox.popleft())
        for chain in self._chains:
            for key in sorted(chain.inbox):
                chain.callback(chain.inbox.pop(key))

    # -- steps -------------------------------------------------------------------------------------------------------

    def _advance(self) -> None:
        """Handle every step whose messages are all here."""
        if self._busy:
            return  # a callback published to this very process (composed): the outer call goes on
        self._busy = True
        try:
            while self._steps and self._ready(self._steps[0]):
                self._handle(self._steps.popleft())
        finally:
            self._busy = False

    def _ready(self, step: Step) -> bool:
        for release in step.released:
            gated = self._gated.get(release.topic)
            if gated is not None:
                gated.announced = True
                gated.released = max(gated.released, release.count)
        stamp = nanoseconds(step.stamp)
        return all(g.received >= g.released for g in self._gated.values() if g.announced) and all(
            stamp in c.inbox for c in self._chains if step.index % c.period == 0)

    def _handle(self, step: Step) -> None:
        self.step = step
        stamp = nanoseconds(step.stamp)
        for topic in sorted(self._gated):
            gated = self._gated[topic]
            keep = gated.received - gated.released if gated.announced else 0
            while len(gated.inbox) > keep:
                gated.callback(gated.inbox.popleft())
        if self._on_step is not None:
            self._on_step(step)
        for chain in self._chains:
            msg = chain.inbox.pop(stamp, None)
            for key in [key for key in chain.inbox if key < stamp]:
                del chain.inbox[key]  # between the steps that this node asks for
            if step.index % chain.period == 0:
                chain.callback(msg)
