"""The arrival host: passes each arriving message to the component and publishes its outputs. Used by `ros2 run` and on vehicles.

It needs only the topics: no simulator and no fixed rate, with any clock.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any

from perch_core.component import Action, Client, Component, Input, Service, Timer, ports
from perch_core.jit import load_cached
from perch_core.ros.component_node import ComponentNode
from perch_core.ros.deadlines import Deadlines
from perch_core.ros.intake import Intake
from perch_core.ros.priority import priority
from perch_core.ros.service_clients import Send, connect_clients
from perch_core.ros.wiring import Wiring, foreign_publishers
from rclpy.clock import Clock, ClockType
from rclpy.timer import Timer as RosTimer

CHECK_PERIOD = 1.0  # of the check for foreign publishers, whose messages are ignored [s]


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
        self._steady_offset = self.host_time() - time.monotonic_ns()  # as measured at the start [ns]
        self._deadlines: Deadlines | None = None
        if deadline:
            load_cached(component.__module__.partition(".")[0], "perch_core")
            self._deadlines = deadlines = Deadlines()
            receivers = getattr(self.component, deadline).receivers
            emit, = receivers

            def answer(value: Any) -> None:
                emit(value)
                deadlines.record_answer(value.stamp, time.monotonic_ns())

            receivers[:] = [answer]  # not one more, which would count as a receiver

    def connect(self) -> None:
        """As in `ComponentNode`."""
        for port in ports(type(self.component), Input):
            self._intake.add(port)
        for timer in ports(type(self.component), Timer):
            self._create_component_timer(timer)
        for client, send in connect_clients(self, self.component).items():
            setattr(self.component, client.name, partial(self._send_request, client, send))
        self.serve()
        if self._intake.private:
            self.create_timer(CHECK_PERIOD, self._warn_foreign_publishers, clock=self._steady)

    def _create_component_timer(self, port: Timer) -> None:
        handler = partial(self.guarded, port.name, port.handler(self.component))

        def call() -> None:
            self._intake.enter(handler, self.host_time() if port.stamping else self._due_time(timer, period))

        timer: RosTimer = self.create_timer(port.period, call, clock=self._steady)
        period = timer.timer_period_ns

    def _due_time(self, timer: RosTimer, period: int) -> int:
        """Return simulation time once it is received; otherwise when the present call of a timer with this period was due [ns].

        The latter is a monotonic time, which goes on where the system's clock is set.
        """
        clock = self.get_clock().handle
        with clock:
            simulated = int(clock.get_now().nanoseconds) if clock.get_ros_time_override_is_enabled() else 0
        return simulated or time.monotonic_ns() + self._steady_offset + timer.time_until_next_call() - period

    def _warn_foreign_publishers(self) -> None:
        """Warn once of each foreign publisher on a topic that a neighbour publishes: its messages are ignored."""
        for topic in sorted(self._intake.private):
            writer = self.wiring.writer(topic) or ""
            for foreign in foreign_publishers(self, topic, {writer}):
                self.warn_once(f"{topic}: messages of {foreign} are ignored: the publisher in this process is {writer}")

    # -- requests ----------------------------------------------------------------------------------------------------

    def dispatch(self, port: Service[Any, Any] | Action, work: Callable[..., None], *arguments: Any) -> None:
        """Call `work` at once."""
        self.wiring.enter(self.guarded, port.name, work, *arguments)

    def _send_request(self, port: Client[Any, Any], send: Send, request: Any, due: int) -> None:
        """Send a component's request; its answer arrives when it does, whatever `due`."""
        send(request, partial(self.wiring.enter, self.guarded, port.name, port.handler(self.component), request))

    # -- diagnostics and priority --------------------------------------------------------------------------------------

    def host_diagnostics(self) -> dict[str, Any]:
        """Figures of the deadlines; empty without a deadline."""
        return self._deadlines.report() if self._deadlines is not None else {}

    def request_real_time(self) -> None:
        """Request real-time scheduling if the node has a deadline."""
        if self._deadlines is None:
            return
        self.wiring.bundled = priority.nodes > 1
        if problem := priority.raise_priority():
            self.get_logger().warning(problem)
