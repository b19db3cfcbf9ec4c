"""Pending requests to planners, and the assignment of answers to them."""

from __future__ import annotations

from dataclasses import dataclass

from perch_core.component import Unavailable
from perch_core.values import NANOSECONDS, PerchPlan, PowerlinePlan

FORGOTTEN = 15 * NANOSECONDS  # a planner that has not answered for so long does not answer any more [ns]
Answer = PerchPlan | PowerlinePlan | Unavailable


@dataclass
class Asked:
    """A pending request: when it was made and from when its answer is used [ns], the plan's start [s], the answer."""

    made: int
    due: int
    start: float
    answer: Answer | None = None


class Requests:
    """Pending requests to one service, in the order in which they were made."""

    def __init__(self) -> None:
        self._under_way: list[Asked] = []

    def add(self, asked: Asked) -> Asked:
        """Add a request; requests that have not been answered within `FORGOTTEN` are dropped."""
        self._under_way = [other for other in self._under_way if asked.made - other.made < FORGOTTEN] + [asked]
        return asked

    def answered(self, answer: Answer) -> None:
        """Assign an answer to the request for its start; one without a trajectory, or with another start, to the oldest one."""
        if not self._under_way:
            return
        start = None if isinstance(answer, Unavailable) or answer.trajectory is None else answer.trajectory.start_time
        asked = next((other for other in self._under_way if other.start == start), self._under_way[0])
        self._under_way.remove(asked)
        asked.answer = answer
