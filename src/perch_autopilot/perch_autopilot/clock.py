"""Clocks of host and autopilot: jumps of the host's, as a component that is woken at a short period sees them; their offset."""

from __future__ import annotations

from perch_core.values import NANOSECONDS, seconds

MAX_STEP = NANOSECONDS  # longest time between two wakes of a node that keeps up [ns]


def clock_jump(before: int | None, now: int) -> str:
    """Describe a jump of the host's clock between the times of two wakes [ns]; empty if there is none, or no earlier wake."""
    if before is None or 0 <= now - before < MAX_STEP:
        return ""
    way, else_ = ("back", "") if now < before else ("on", ", or this node was suspended")
    return f"the clock went {way} by {abs(seconds(now - before)):.3f} s at once: it was set{else_}"


class ClockOffset:
    """Offset between the clocks of the host and the autopilot, by TIMESYNC: the exchange with the shortest round trip counts.

    Attributes:
        offset: time of the host - time of the autopilot [ns]; None: unknown.
    """

    def __init__(self) -> None:
        self.offset: int | None = None
        self._way = float("inf")

    def answered(self, sent: int, theirs: int, now: int) -> None:
        """Record an answer: host's time of the request, stamp of the autopilot, host's time of arrival [ns]."""
        way = now - sent
        if not 0 <= way < NANOSECONDS:
            return
        self._way *= 1.02  # clocks drift: an old exchange counts less and less
        if way <= self._way or (self.offset is not None and abs((sent + now) // 2 - theirs - self.offset) > way + NANOSECONDS // 10):
            self._way, self.offset = way, (sent + now) // 2 - theirs
