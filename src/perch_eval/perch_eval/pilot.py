"""The user's side of a flight: sends the Perch goal, follows its feedback, waits for its result."""

from __future__ import annotations

import math
import signal
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import rclpy
from geometry_msgs.msg import Point
from perch_msgs.action import Perch
from perch_msgs.msg import Step
from rclpy.action import ActionClient
from rclpy.context import Context
from rclpy.experimental import EventsExecutor
from rclpy.node import Node

from perch_core.errors import PerchError
from perch_core.ros import qos
from perch_core.scenario import Scenario

SERVICES = {"perching_planner": "plan_perch", "powerline_planner": "plan_powerline"}
"""Services that a planner offers once it is compiled and warm, which may be long after its node is visible."""
START_PATIENCE = 300.0  # [s] a node whose sources changed compiles first
OUTCOMES = dict(enumerate(
    ("perched", "not_found", "refused", "missed", "tracking_lost", "cancelled", "timeout", "bad_goal", "crashed")))
SUCCESSES = ("perched", "inspected")
"""Outcomes of a flight that did what was asked."""


@dataclass(frozen=True)
class FlightResult:
    """How a goal ended.

    Attributes:
        outcome: `perched` or the lower-case name of the error code.
        message: the mission's words.
        end_time: simulation time at the end [s].
        wall_time: wall-clock time from the goal to the end [s].
        start_time: simulation time when the goal was sent [s]; None where it never was.
    """

    outcome: str
    message: str
    end_time: float
    wall_time: float
    start_time: float | None = None


def goal_of(scenario: Scenario) -> Perch.Goal:
    """The goal that a scenario's mission part describes."""
    mission = scenario.mission
    goal = Perch.Goal(
        takeoff_height=mission.takeoff_height, search_timeout=mission.search_timeout, inclination_hint=math.nan,
        replan=mission.replan, attempts=mission.attempts, perception_aware=mission.perception_aware,
        perch_pitch=math.radians(mission.perch_pitch_deg))
    if scenario.mode == "powerline":
        goal.mode = Perch.Goal.MODE_POWERLINE
        goal.perch_point = Point(x=mission.perch_point[0], y=mission.perch_point[1], z=mission.perch_point[2])
    if scenario.mode == "inspection":
        goal.mode = Perch.Goal.MODE_INSPECTION
        x, y, z = scenario.inspection.watched
        goal.perch_point = Point(x=x, y=y, z=z)
    return goal


class Pilot:
    """An action client in a ROS context of its own."""

    def __init__(self, namespace: str = "") -> None:
        self._context = Context()
        rclpy.init(context=self._context)
        self._node = Node("pilot", namespace=namespace or None, context=self._context, start_parameter_services=False)
        self._executor = EventsExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._client = ActionClient(self._node, Perch, "perch")
        self._time = 0.0
        self._interrupted, self._handler = False, None
        if threading.current_thread() is threading.main_thread():
            self._handler = signal.signal(signal.SIGINT, self._interrupt)
        self._node.create_subscription(Step, "tick", self._receive_tick, qos.LATCHED)

    def _interrupt(self, *_: Any) -> None:
        self._interrupted = True

    def _spin(self, timeout: float) -> None:
        """Run callbacks; an interrupt counts afterwards, as rclpy's C++ cannot pass on an exception out of a callback."""
        self._executor.spin_once(timeout_sec=timeout)
        if self._interrupted:
            raise KeyboardInterrupt

    @property
    def time(self) -> float:
        """Newest simulation time seen [s]."""
        return self._time

    def visible_nodes(self) -> set[str]:
        """Fully qualified names of the nodes in the graph."""
        self._spin(0.02)
        return {f"{ns.rstrip('/')}/{name}" for name, ns in self._node.get_node_names_and_namespaces()}

    def fly(self, scenario: Scenario, on_phase: Callable[[float, str, str], None] = lambda *_: None,
            check: Callable[[], None] = lambda: None, stall: float = 60.0) -> FlightResult:
        """Send the goal and wait for its end; past the scenario's time limit it is cancelled.

        Args:
            scenario: what to fly.
            on_phase: receives (simulation time [s], phase, message) when the phase or its message changes.
            check: called often; may raise to end the wait (a node that died).
            stall: wall-clock time without progress of simulation time after which the flight has failed [s].

        Raises:
            PerchError: the mission does not answer, refuses the goal, or simulation time stands still.
        """
        seen = ("", "")

        def feedback(msg) -> None:
            nonlocal seen
            now = (msg.feedback.phase, msg.feedback.message)
            if now != seen:
                seen = now
                on_phase(self._time, *now)

        self._spin_until(self._client.server_is_ready, check, stall, "the mission's action server does not appear")
        for node, service in SERVICES.items():
            if node in scenario.nodes:
                name = self._node.resolve_service_name(service)
                self._spin_until(lambda: self._node.count_services(name) > 0, check, START_PATIENCE, f"{node} does not offer {service}")
        self._spin_until(lambda: self._time > 0.0, check, START_PATIENCE, "simulation time does not begin")
        began, started = time.monotonic(), self._time
        sent = self._client.send_goal_async(goal_of(scenario), feedback_callback=feedback)
        self._spin_until(sent.done, check, stall, "the mission does not answer to the goal")
        handle = sent.result()
        if not handle.accepted:
            raise PerchError("the mission refused the goal: it is flying another one")
        result = handle.get_result_async()
        cancelled = False
        last_time, last_progress = self._time, time.monotonic()
        while not result.done():
            self._spin(0.05)
            check()
            if self._time > last_time:
                last_time, last_progress = self._time, time.monotonic()
            elif time.monotonic() - last_progress > stall:
                raise PerchError(f"simulation time has stood still at {self._time:.3f} s for {stall:g} s")
            if self._time > scenario.time_limit and not cancelled:
                cancelled = True
                on_phase(self._time, "cancelling", f"time limit of {scenario.time_limit:g} s reached")
                handle.cancel_goal_async()
        answer = result.result().result
        outcome = OUTCOMES[answer.error_code]
        if cancelled and outcome == "cancelled":
            outcome = "timeout"
        elif answer.success and scenario.mode == "inspection":
            outcome = "inspected"
        return FlightResult(outcome, answer.message, answer.end_time or self._time, time.monotonic() - began, started)

    def linger(self, duration: float, check: Callable[[], None] = lambda: None, patience: float = 5.0) -> None:
        """Let simulation time go on for a while, so that the recording shows the rest."""
        end, last = self._time + duration, time.monotonic() + patience
        while self._time < end and time.monotonic() < last:
            self._spin(0.05)
            check()

    def close(self) -> None:
        """Leave the graph."""
        if self._handler is not None:
            signal.signal(signal.SIGINT, self._handler)
        self._node.destroy_node()
        self._context.try_shutdown()

    def _spin_until(self, done: Callable[[], bool], check: Callable[[], None], timeout: float, problem: str) -> None:
        last = time.monotonic() + timeout
        while not done():
            self._spin(0.05)
            check()
            if time.monotonic() > last:
                raise PerchError(f"{problem} within {timeout:g} s")

    def _receive_tick(self, step: Step) -> None:
        self._time = max(self._time, step.stamp.sec + 1e-9 * step.stamp.nanosec)
