"""The action client of a flight: sends the Perch goal, follows its feedback, waits for its result."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection
from dataclasses import dataclass
from functools import partial
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from perch_msgs.action import Perch
from rclpy.action import ActionClient
from rosgraph_msgs.msg import Clock
from std_srvs.srv import Trigger

from perch_core.errors import PerchError
from perch_core.ros import topics
from perch_core.ros.messages.mission import goal_message
from perch_eval.goal import goal_of, outcome_of
from perch_eval.nodes import in_namespace
from perch_eval.ros.graph_node import GraphNode
from perch_sim.scenario import Scenario

SERVICES = {"perching_planner": "plan_perch", "powerline_planner": "plan_powerline"}
"""Services that a planner offers once it is compiled and warmed up, which may be long after its node is visible."""
STALL_TIMEOUT = 60.0    # without progress or an answer of the mission [s]
START_TIMEOUT = 300.0   # [s] a node whose sources changed compiles first
CANCEL_TIMEOUT = 60.0   # simulation time that the mission has to end a cancelled goal: to leave a perch, or to descend [s]
CHECK_PERIOD = 0.5      # of the check whether the mission that took the goal is still there [s]
EXPLAIN_AFTER = 5.0     # simulation time that has not advanced for so long is explained [s]
CLOCK_JUMP_MAX = 10.0   # by which one message of the clock may be ahead [s], plus ...
CLOCK_RATE_MAX = 50.0   # ... so many times the wall-clock time since the last one; others are not of the simulation
CLOCK_FIRST_MAX = 1e8   # of the first one [s]: no simulation has run for years, and the wall clock shows more
SILENCE_TIMEOUT = 3.0   # a node that has sent no diagnostics for so long is reported [s]


@dataclass(frozen=True)
class FlightResult:
    """How a goal ended.

    Attributes:
        outcome: `perched`, `inspected`, `timeout`, or the lower-case name of the error code.
        message: of the mission.
        end_time: simulation time at the end [s].
        wall_time: wall-clock time to the end from the goal or, if later, from the start of simulation time [s].
        start_time: simulation time at that start [s]; None if no goal was sent.
    """

    outcome: str
    message: str
    end_time: float
    wall_time: float
    start_time: float | None = None


class MissionClient(GraphNode):
    """Client of the mission. Time is that of `/clock`, or of `clock` in the namespace if there is one.

    Attributes:
        time: newest simulation time seen [s].
        processes: node -> its process, from its newest diagnostics; changes when the node is restarted.
    """

    def __init__(self, namespace: str = "") -> None:
        """
        Args:
            namespace: of the vehicle's nodes, as in `/quad1`.
        """
        super().__init__("mission_client", in_namespace(namespace))
        self._client = ActionClient(self.node, Perch, "perch")
        self._vehicle = self.node.get_namespace().rstrip("/") + "/vehicle"
        self.time, self._last_check = 0.0, 0.0
        self._waits: dict[str, str] = {}  # node -> what it waits for, by its newest diagnostics
        self._last_clock = time.monotonic()  # when time advanced last [s]
        self._last_message: dict[str, float] = {}  # node -> when its diagnostics came last, monotonic clock [s]
        self.processes: dict[str, str] = {}
        self._silent: set[str] = set()
        self._node_events: list[str] = []
        self.node.create_subscription(Clock, "/clock", self._receive_clock, topics.topic("/clock").qos.subscribe)
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._receive_diagnostics,
                                       topics.topic("/diagnostics").qos.subscribe)

    @property
    def waiting_for(self) -> str:
        """The participants and messages that the vehicle waits for, and the servers that other nodes wait for; empty: none."""
        own = self._vehicle.removesuffix("vehicle")
        others = [f"{name} for {text}" for name, text in sorted(self._waits.items()) if name.startswith(own) and name != self._vehicle and text]
        return "; ".join(filter(None, [self._waits.get(self._vehicle, ""), *others]))

    def node_events(self) -> list[str]:
        """Return messages on nodes that, since the last call, were restarted or became silent while others publish.

        Nodes of one process take turns: if one of them publishes, the others count as waiting, not silent.
        """
        now, (events, self._node_events) = time.monotonic(), (self._node_events, [])
        if now - max(self._last_message.values(), default=0.0) < 0.5 * SILENCE_TIMEOUT:
            last_of_process: dict[str, float] = {}
            for name, received in self._last_message.items():
                process = self.processes.get(name, name)
                last_of_process[process] = max(received, last_of_process.get(process, 0.0))
            silent = {name for name in self._last_message if now - last_of_process[self.processes.get(name, name)] > SILENCE_TIMEOUT}
            events += [f"{name} has sent no diagnostics for {SILENCE_TIMEOUT:g} s: it hangs or has ended, or the machine is overloaded"
                       for name in sorted(silent - self._silent)]
            self._silent = silent
        return events

    def fly(self, scenario: Scenario, on_phase: Callable[[float, str, str], None] = lambda *_: None,
            check: Callable[[], None] = lambda: None, stall_timeout: float = STALL_TIMEOUT) -> FlightResult:
        """Send the goal and wait for its end; it is cancelled when the scenario's time limit is exceeded.

        Args:
            scenario: what to fly.
            on_phase: called with (simulation time [s], phase, message) when phase or message changes, when a node becomes silent
                or was restarted, and, with the awaited participants, when simulation time stops.
            check: called often; may raise to end the wait (for example after the end of a node).
            stall_timeout: wall-clock time without progress of simulation time after which the flight has failed [s].

        Raises:
            PerchError: the mission does not answer, refuses the goal, ends, or does not end a cancelled one; or time stops.
        """
        reported = ("", "")

        def feedback(msg: Any) -> None:
            nonlocal reported
            now = (msg.feedback.phase, msg.feedback.message)
            if now != reported:
                reported = now
                on_phase(self.time, *now)

        self._spin_until(self._client.server_is_ready, check, START_TIMEOUT, "the mission's action server does not appear")
        for node, service in SERVICES.items():
            if node in scenario.nodes:
                offered = partial(self.node.count_services, self.node.resolve_service_name(service))
                self._spin_until(offered, check, START_TIMEOUT, f"{node} does not offer {service}")
        servers, explained = self._servers(), math.nan  # simulation time whose standing still was explained [s]
        began, start = time.monotonic(), self.time
        sent = self._client.send_goal_async(goal_message(goal_of(scenario)), feedback_callback=feedback)

        def answered() -> bool:
            self._check_graph(servers, scenario.nodes)
            return bool(sent.done())

        self._spin_until(answered, check, stall_timeout, "the mission does not answer the goal request")
        handle = sent.result()
        if not handle.accepted:
            raise PerchError("the mission refused the goal: it is flying another one")
        result = handle.get_result_async()
        cancelled = math.inf
        while not result.done():
            self.spin(0.05)
            check()
            for text in self.node_events():
                on_phase(self.time, reported[0], text)
            self._check_graph(servers, scenario.nodes)
            if start == 0.0 < self.time:  # it begins
                began, start = time.monotonic(), self.time
            stopped = time.monotonic() - max(self._last_clock, began)
            if stopped > EXPLAIN_AFTER and explained != self.time:
                explained = self.time
                on_phase(self.time, "waiting", f"simulation time has stopped: {self._waiting_text()}")
            if stopped > (stall_timeout if self.time > 0.0 else START_TIMEOUT):
                raise PerchError(f"simulation time has been stopped at {self.time:.3f} s for {stopped:.0f} s: {self._waiting_text()}")
            if self.time - cancelled > CANCEL_TIMEOUT:
                raise PerchError(f"the mission has not ended the goal in {CANCEL_TIMEOUT:g} s since it was cancelled")
            if self.time - start > scenario.time_limit and cancelled == math.inf:
                cancelled = self.time
                on_phase(self.time, "cancelling", f"time limit of {scenario.time_limit:g} s reached")
                handle.cancel_goal_async()
        answer = result.result().result
        outcome = outcome_of(answer.error_code, scenario, timed_out=cancelled < math.inf)
        return FlightResult(outcome, answer.message, answer.end_time or self.time, time.monotonic() - began, start)

    def depart(self, check: Callable[[], None]) -> tuple[bool, str]:
        """Command a perched vehicle to depart to a hover.

        Args:
            check: called often; may raise to end the wait.

        Returns:
            Whether it hovers, and the mission's message.

        Raises:
            PerchError: the mission does not answer.
        """
        client = self.node.create_client(Trigger, "depart")
        try:
            self._spin_until(client.service_is_ready, check, STALL_TIMEOUT, "the mission does not offer depart")
            answer = client.call_async(Trigger.Request())
            self._spin_until(answer.done, check, STALL_TIMEOUT, "the mission does not answer the request to depart")
            return answer.result().success, answer.result().message
        finally:
            self.node.destroy_client(client)

    def linger(self, duration: float, check: Callable[[], None] = lambda: None, timeout: float = 30.0) -> None:
        """Wait until simulation time has advanced by `duration` [s], so that the recording covers what follows."""
        end = self.time + duration

        def over() -> bool:
            check()
            return self.time >= end

        self.spin_until(over, timeout)

    def close(self) -> None:
        """Leave the graph."""
        self._client.destroy()
        super().close()

    def _servers(self) -> set[bytes]:
        """Return the endpoint ids of the action servers."""
        topic = f"{self.node.resolve_service_name('perch')}/_action/status"
        return {bytes(info.endpoint_gid) for info in self.node.get_publishers_info_by_topic(topic)}

    def _check_graph(self, servers: set[bytes], nodes: Collection[str]) -> None:
        """Raise PerchError if the action server that took the goal has ended; start monitoring the scenario's visible nodes."""
        if time.monotonic() - self._last_check < CHECK_PERIOD:
            return
        self._last_check = time.monotonic()
        for name in self.nodes() & {self._vehicle.removesuffix("vehicle") + node for node in nodes}:
            self._last_message.setdefault(name, self._last_check)
        now = self._servers()
        if servers and (not now or now - servers):
            raise PerchError(f"the mission {'was restarted' if now else 'has ended'}: its goal was dropped")

    def _waiting_text(self) -> str:
        return f"waiting for {self.waiting_for}" if self.waiting_for else f"{self._vehicle} reports no reason"

    def _spin_until(self, done: Callable[[], object], check: Callable[[], None], timeout: float, problem: str) -> None:
        def over() -> object:
            check()
            return done()

        if not self.spin_until(over, timeout):
            waiting = f" (the vehicle is waiting for {self.waiting_for})" if self.waiting_for else ""
            raise PerchError(f"{problem} within {timeout:g} s{waiting}")

    def _receive_clock(self, msg: Clock) -> None:
        """Advance time; rclpy does not tell who has sent a message, so a foreign clock is recognised by its implausible jump."""
        clock, now = msg.clock.sec + 1e-9 * msg.clock.nanosec, time.monotonic()
        jump_max = CLOCK_JUMP_MAX + CLOCK_RATE_MAX * (now - self._last_clock) if self.time else CLOCK_FIRST_MAX
        if 0.0 < clock - self.time <= jump_max:
            self.time, self._last_clock = clock, now

    def _receive_diagnostics(self, msg: DiagnosticArray) -> None:
        for status in msg.status:
            self._last_message[status.name] = time.monotonic()
            if self.processes.setdefault(status.name, status.hardware_id) != status.hardware_id:
                self.processes[status.name] = status.hardware_id
                self._node_events.append(f"{status.name} was restarted")
            self._waits[status.name] = next((pair.value for pair in status.values if pair.key == "waiting_for"), "")
