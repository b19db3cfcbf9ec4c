"""Ways out of a plan in flight: they are asked for one after the other, from states of the plan that lie ahead. [P:V-B]"""

from __future__ import annotations

import math
from dataclasses import dataclass

DECISION = 0.04  # from an answer to the start of what it brings: the mission's latency and a tick [s]


@dataclass
class WaysOut:
    """Where the ways out of one plan begin.

    Attributes:
        covered: where the next one begins at the earliest, less `spacing` [s].
        until: none begins later [s].
        spacing: between their starts [s].
        last: start of the latest that there is [s].
        refusal: why there is none from `covered` on; empty: it was not refused.
    """

    covered: float
    until: float
    spacing: float
    last: float = -math.inf
    refusal: str = ""

    def next(self, soonest: float) -> float | None:
        """Where the next one to be asked for begins [s], not before `soonest`; None: there are all."""
        start = max(soonest, self.covered + self.spacing)
        return start if start < self.until else None

    def answered(self, start: float, refusal: str) -> None:
        """Take the answer to the question for the one that begins at `start` [s]; an empty refusal: there is one."""
        self.covered, self.refusal = start, refusal
        if not refusal:
            self.last = start

    def committed(self, time: float) -> str:
        """Why the plan can no longer be left at a time [s]; empty: it can, or this is not known yet."""
        if self.last >= time or self.next(time) is not None:
            return ""
        return self.refusal or "the contact may come at any moment"
