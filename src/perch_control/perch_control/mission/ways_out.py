"""Ways out (planned recoveries) of a plan in flight, requested one after the other from future states of the plan. [P:V-B]"""

from __future__ import annotations

import math
from dataclasses import dataclass

DECISION = 0.04  # from an answer to the start of what it brings: the mission's latency and a tick [s]
SPACING_MIN = 0.05  # between two starts [s]


@dataclass
class WaysOut:
    """Start times of the ways out of one plan.

    Attributes:
        covered: start of the last one that was answered [s]; the next one begins at least `spacing` later, or at `until`.
        until: start of the last one [s], unless it is nearer than `SPACING_MIN` to the one before.
        spacing: least time between the others [s].
        last: start of the latest one that was found [s].
        refusal: why the one at `covered` was refused; empty: it was not.
    """

    covered: float
    until: float
    spacing: float
    last: float = -math.inf
    refusal: str = ""

    def next(self, soonest: float) -> float | None:
        """Return the start of the next one to request [s], not before `soonest`; None: all have been requested."""
        if max(soonest, self.covered + SPACING_MIN) >= self.until:
            return None
        return min(max(soonest, self.covered + self.spacing), self.until)

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
