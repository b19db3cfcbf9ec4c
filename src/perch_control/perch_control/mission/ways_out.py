"""Ways out (planned recoveries) of a plan in flight, requested one after the other from future states of the plan. [P:V-B]"""

from __future__ import annotations

import math
from dataclasses import dataclass

from perch_control.mission.values import TICK

DECISION = 0.04  # from an answer to the start of what it brings: the mission's latency and a tick [s]


@dataclass
class WaysOut:
    """Start times of the ways out of one plan.

    Attributes:
        covered: start of the last one that was answered [s]; the next one begins at least `spacing` later.
        until: every start is before this time [s].
        spacing: least time between two starts [s].
        closing: whether one more begins at `until`, less than `spacing` after the one before.
        last: start of the latest one that was found [s].
        refusal: why the one at `covered` was refused; empty: it was not.
    """

    covered: float
    until: float
    spacing: float
    closing: bool = False
    last: float = -math.inf
    refusal: str = ""

    def next(self, soonest: float) -> float | None:
        """Return the start of the next one to request [s], not before `soonest`; None: all have been requested."""
        start = max(soonest, self.covered + self.spacing)
        if start < self.until:
            return start
        return self.until if self.closing and max(soonest, self.covered + TICK) <= self.until else None

    def answered(self, start: float, refusal: str) -> None:
        """Take the answer to the request for the one that begins at `start` [s]; an empty refusal: it was found."""
        self.covered, self.refusal = start, refusal
        if not refusal:
            self.last = start

    def committed(self, time: float) -> str:
        """Return why the plan can no longer be left at a time [s]; empty: it can, or this is not known yet."""
        if self.last >= time or self.next(time) is not None:
            return ""
        return self.refusal or "the contact may come at any moment"
