"""A goal in progress: of the Perch action, or of the service `depart`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from perch_core.component import Goal
from perch_core.values import PerchFeedback, PerchGoal, PerchResult, TriggerResponse
from perch_control.mission.machine import MissionMachine
from perch_control.mission.pending_requests import PendingRequest


@dataclass
class RunningGoal:
    """A goal in progress.

    Attributes:
        goal: as passed by the host.
        machine: state machine that executes the goal.
        started: whether the machine has been started.
        waiting_since: host time since which the goal waits for odometry [ns].
        pending: the latest request to the planner, until its answer is used.
        way_out: the same, for a way out of a perch on a surface.
        overdue: what has been awaited for too long, and the nodes that owe it; empty: nothing.
    """

    goal: Goal
    machine: MissionMachine
    started: bool = False
    waiting_since: int | None = None
    pending: PendingRequest | None = None
    way_out: PendingRequest | None = None
    overdue: str = ""

    @property
    def message(self) -> str:
        """That of the feedback."""
        return self.with_overdue(self.machine.message if self.started else "waiting for the estimator")

    def with_overdue(self, message: str) -> str:
        """Return a message, followed by what is overdue."""
        return f"{message}; {self.overdue}" if self.overdue else message


class DepartureGoal:
    """A departure with the interface of a goal; its end answers the service request."""

    value, cancel_requested = PerchGoal(), False

    def __init__(self, reply: Callable[[TriggerResponse], None]) -> None:
        self._reply = reply

    def feedback(self, value: PerchFeedback) -> None:
        """Do nothing: the service has no feedback."""

    def finish(self, ending: str, result: PerchResult) -> None:
        """Answer the request."""
        self._reply(TriggerResponse(result.success, result.message))
