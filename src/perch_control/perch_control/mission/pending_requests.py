"""A pending request to a planner."""

from __future__ import annotations

from dataclasses import dataclass

from perch_core.component import Unavailable
from perch_core.values import PerchPlan, PerchPlanRequest, PowerlinePlan, PowerlinePlanRequest

Request = PerchPlanRequest | PowerlinePlanRequest
Answer = PerchPlan | PowerlinePlan | Unavailable


@dataclass
class PendingRequest:
    """A pending request: its service, when it was made and from when its answer is used [ns], the request itself, the answer."""

    channel: str
    made: int
    due: int
    request: Request
    answer: Answer | None = None
