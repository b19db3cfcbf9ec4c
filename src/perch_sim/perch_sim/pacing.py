"""Real-time pacing: number of steps that are due by the wall clock, and of those that were missed."""

from __future__ import annotations

MAX_CATCH_UP = 25  # steps; time lost beyond this is skipped


class Pacing:
    """Paces periodic steps by a clock. Pure: times are arguments, in nanoseconds."""

    def __init__(self, period: int, now: int) -> None:
        self._period, self._epoch, self._done = period, now, 0
        self.misses = 0   # steps that began more than a period late
        self.skipped = 0  # periods of wall-clock time that were skipped

    def due(self, now: int) -> int:
        """Return the number of steps that the caller is to execute at the time `now`."""
        behind = (now - self._epoch) // self._period - self._done
        if behind <= 0:
            return 0
        self.misses += behind - 1
        if behind > MAX_CATCH_UP:
            lost = behind - MAX_CATCH_UP
            self.skipped += lost
            self._epoch += lost * self._period
            behind = MAX_CATCH_UP
        self._done += behind
        return behind
