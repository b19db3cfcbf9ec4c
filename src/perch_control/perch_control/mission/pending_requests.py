"""Pending requests to planners, and the assignment of answers to them."""

from __future__ import annotations

from dataclasses import dataclass

from perch_core.component import Unavailable
from perch_core.values import NANOSECONDS, PerchPlan, PowerlinePlan

REQUEST_TIMEOUT = 15 * NANOSECONDS  # an answer is no longer expected after so long [ns]
Answer = PerchPlan | PowerlinePlan | Unavailable


@dataclass
class PendingRequest:
    """A pending request: its service, when it was made and from when its answer is used [ns], the plan's start [s], the answer."""

    channel: str
    made: int
    due: int
    start: float
    answer: Answer | None = None


class Requests:
    """Pending requests to one service, in the order in which they were made."""

    def __init__(self) -> None:
        self._pending: list[PendingRequest] = []

    def add(self, request: PendingRequest) -> PendingRequest:
        """Add a request; requests that have not been answered within `REQUEST_TIMEOUT` are dropped."""
        self._pending = [other for other in self._pending if request.made - other.made < REQUEST_TIMEOUT] + [request]
        return request

    def answered(self, answer: Answer) -> None:
        """Assign an answer to the request for its start; one without a trajectory, or with another start, to the oldest one."""
        if not self._pending:
            return
        start = None if isinstance(answer, Unavailable) or answer.trajectory is None else answer.trajectory.start_time
        request = next((other for other in self._pending if other.start == start), self._pending[0])
        self._pending.remove(request)
        request.answer = answer
