"""The arrival host: passes each arriving message to the component and publishes its outputs. Used by `ros2 run` and on vehicles.

It needs only the topics: no simulator and no fixed rate, with any clock.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any

from perch_core.component import Action, Client, Component, Input, Service, Wake, ports
from perch_core.ros.asking import connect_clients
from perch_core.ros.component_node import ComponentNode
from perch_core.ros.deadlines import Deadlines
from perch_core.ros.intake import Intake
from perch_core.ros.priority import priority
from perch_core.ros.wiring import Wiring, foreign_writers
from rclpy.clock import Clock, ClockType

LOOK = 1.0  # between two looks for writers that are not heard [s]


class ArrivalNode(ComponentNode):
    """Node of one component whose inputs are processed as their messages arrive."""

    def __init__(self, name: str, component: type[Component[Any]], wiring: Wiring, deadline: str = "", **kwargs: Any) -> None:
        """
        Args:
            name, component, wiring, kwargs: as in `ComponentNode`.
            deadline: output that answers each input of the same stamp within one period; late answers are counted.
        """
        super().__init__(name, component, wiring, **kwargs)
        self._intake = Intake(self)
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._deadlines: Deadlines | None = None
        if deadline:
            self._deadlines = late = Deadlines()
            getattr(self.component, deadline).receivers.append(lambda value: late.answered(value.stamp, time.monotonic_ns()))

    def connect(self) -> None:
        """As in `ComponentNode`."""
        for given in ports(type(self.component), Input):
            self._intake.add(given)
        for wake in ports(type(self.component), Wake):
            self._wake(wake)
        connect_clients(self, self.component, self._deliver_answer)
        self.serve()
        if self._intake.private:
            self.create_timer(LOOK, self._look_for_strangers, clock=self._steady)

    def _wake(self, port: Wake) -> None:
        handler, clock = partial(self.guarded, port.name, port.handler(self.component)), self.get_clock().handle

        def wake() -> None:
            with clock:
                now = clock.get_now().nanoseconds  # as `Clock.now` has it, without an object of the time: this runs at 500 Hz
            self._intake.enter(handler, now)

        self.create_timer(port.period, wake, clock=self._steady)

    def _look_for_strangers(self) -> None:
        """Warn once of each foreign publisher on a topic that a neighbour publishes: its messages are ignored."""
        for topic in sorted(self._intake.private):
            writer = self.wiring.writer(topic) or ""
            for stranger in foreign_writers(self, topic, {writer}):
                self.warn_once(f"{topic}: {stranger} publishes it, too, and is ignored: {writer} does in this process")

    # -- requests ----------------------------------------------------------------------------------------------------

    def bring(self, port: Service[Any, Any] | Action, work: Callable[..., None], *arguments: Any) -> None:
        """Call `work` at once."""
        self.wiring.enter(self.guarded, port.name, work, *arguments)

    def _deliver_answer(self, port: Client[Any, Any], answer: Any) -> None:
        self.wiring.enter(self.guarded, port.name, port.handler(self.component), answer)

    # -- people ------------------------------------------------------------------------------------------------------

    def host_figures(self) -> dict[str, Any]:
        """Figures of the deadlines; empty without a deadline."""
        return self._deadlines.report() if self._deadlines is not None else {}

    def hurry(self) -> None:
        """Request real-time scheduling if the node has a deadline."""
        if self._deadlines is None:
            return
        self.wiring.paced = priority.nodes > 1
        if problem := priority.ask():
            self.get_logger().warning(problem)
