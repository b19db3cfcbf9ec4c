"""Lockstep with people and processes that fail: waits for participants to come, names and drops the silent."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

from rclpy.node import Node
from rclpy.publisher import Publisher

from perch_sim.lockstep_master import LockstepMaster
from perch_sim.participants import CONTROLLER, Trigger

NAG = 10.0          # a wait is named this often [s]
SETTLED_LOOKS = 3   # the graph has to look complete this often in a row before the first step


class LockstepWatch:
    """`LockstepMaster` with the graph and the wall clock around it."""

    def __init__(self, node: Node, triggers: tuple[Trigger, ...], controller: bool, publishers: Sequence[Publisher],
                 timeout: float, start_timeout: float, ready: Callable[[], bool]) -> None:
        """
        Args:
            node: the vehicle.
            triggers: of the slow participants.
            controller: whether the controller takes part.
            publishers: the vehicle's; all their known subscriptions must be matched before the first step.
            timeout: a participant silent for so long is dropped [s, wall clock].
            start_timeout: one that never came is dropped after so long [s, wall clock].
            ready: whether the vehicle itself can begin: its images are drawn by processes that take a while to start.
        """
        self.triggers = triggers
        self._node, self._publishers, self._controller = node, publishers, controller
        self._timeout, self._start_timeout, self._ready = timeout, start_timeout, ready
        self._master = LockstepMaster(tuple(t.node for t in triggers), controller)
        self._started, self._looks = False, 0
        self._begun = self._progress = self._named = time.monotonic()
        self._late: set[str] = set()  # never came, or silent: dropped
        self.waiting = "the participants to come"

    # -- passed on ---------------------------------------------------------------------------------------------------

    def command(self, stamp: int) -> None:
        """A motor command has come."""
        if self._master.command(stamp):
            self._progress = time.monotonic()
        elif CONTROLLER in self._late:
            self._late.discard(CONTROLLER)
            self._master.take_back_controller()
            self._node.get_logger().warning("lockstep: controller is back")

    def report(self, node: str, trigger: int, counts: dict[str, int]) -> None:
        """A report or greeting has come."""
        try:
            returned = self._master.report(node, trigger, counts)
        except KeyError:
            self._node.get_logger().warning(
                f"lockstep: {node!r} sends reports but is not in the parameter participants: its results are not waited for",
                once=True)
            return
        self._progress = time.monotonic()
        if returned:
            self._late.discard(node)
            self._node.get_logger().warning(f"lockstep: {node} is back")

    def trigger(self, node: str, trigger: int, due: int) -> None:
        """A participant has been given work."""
        self._master.trigger(node, trigger, due)

    def cancel(self, node: str, trigger: int) -> None:
        """Work that was given to a participant cannot be done."""
        self._master.cancel(node, trigger)

    def begin(self, stamp: int) -> dict[str, int]:
        """Begin a step; returns what it releases."""
        self._progress = time.monotonic()
        return self._master.begin(stamp)

    @property
    def led(self) -> bool:
        """Whether the flight waits for motor commands; without them nothing slows it."""
        return self._master.led

    # -- may it go on? -----------------------------------------------------------------------------------------------

    def may_advance(self) -> bool:
        """Whether physics may go on to the next step."""
        return self._started and not self._master.missing_command

    def missing(self, stamp: int) -> tuple[str, ...]:
        """Participants whose result is due at the step and has not come."""
        return self._master.missing_results(stamp)

    # -- the silent --------------------------------------------------------------------------------------------------

    def look_after(self, stamp: int) -> None:
        """Call every 50 ms of wall-clock time: starts the run, names what is waited for, drops the silent.

        Args:
            stamp: of the step that is to be published next [ns], 0: none.
        """
        now = time.monotonic()
        if not self._started:
            self._look_at_graph(now)
            return
        silent = self._silent(stamp)
        self.waiting = ", ".join(silent)
        if not silent:
            return
        for name in silent:
            if now - self._progress > self._timeout and self._may_drop(name):
                self._drop(name, f"silent for {self._timeout:g} s")
                self._progress = now
        self._nag(now)

    def _silent(self, stamp: int) -> tuple[str, ...]:
        return self._master.missing_results(stamp) + ((CONTROLLER,) if self._master.missing_command else ())

    def _may_drop(self, name: str) -> bool:
        """A participant that still lives may take its time over its first work: it compiles, or waits for a goal."""
        if name == CONTROLLER or self._master.has_reported(name):
            return True
        return name not in self._node.get_node_names()

    def _drop(self, name: str, why: str) -> None:
        hint = " (or the estimator before it)" if name == CONTROLLER else ""
        self._node.get_logger().error(f"lockstep: {name}{hint} {why}: dropped, the flight goes on without it")
        self._late.add(name)
        if name == CONTROLLER:
            self._master.drop_controller()
        else:
            self._master.drop(name)

    def _nag(self, now: float) -> None:
        if now - max(self._named, self._progress) > NAG:
            self._named = now
            self._node.get_logger().info(f"lockstep: waiting for {self.waiting}")

    # -- start -------------------------------------------------------------------------------------------------------

    def _look_at_graph(self, now: float) -> None:
        missing = self._missing()
        ready = self._ready()
        self.waiting = ", ".join(missing) or ("subscriptions to be matched" if ready else "the first images to be drawn")
        complete = not missing and ready and self._all_matched()
        self._looks = self._looks + 1 if complete else 0
        if self._looks >= SETTLED_LOOKS:
            self._started, self._progress = True, now
            self.waiting = ""
            names = [t.node for t in self.triggers] + [CONTROLLER] * self._controller
            names = [name for name in names if name not in self._late]
            self._node.get_logger().info(f"lockstep: starting with {', '.join(names) or 'no participants'}")
            return
        if missing and now - self._begun > self._start_timeout:
            for name in missing:
                self._drop(name, f"did not come within {self._start_timeout:g} s")
        self._nag(now)

    def _missing(self) -> tuple[str, ...]:
        """Participants that are not there, or not connected yet."""
        missing = list(self._master.missing_greetings())
        for trigger in self.triggers:
            if trigger.node not in missing and trigger.node not in self._late and not self._listens(trigger):
                missing.append(trigger.node)
        if self._controller and CONTROLLER not in self._late and not self._node.count_publishers("motor_command"):
            missing.append(CONTROLLER)
        return tuple(missing)

    def _listens(self, trigger: Trigger) -> bool:
        """Whether the participant's subscription to what triggers it is known."""
        return any(info.node_name == trigger.node and info.node_namespace == self._node.get_namespace()
                   for info in self._node.get_subscriptions_info_by_topic(trigger.topic))

    def _all_matched(self) -> bool:
        return all(p.get_subscription_count() >= self._node.count_subscribers(p.topic_name) for p in self._publishers)
