"""Real-time pacing: number of steps that are due by the wall clock, and of those that were missed."""

from __future__ import annotations

LONGEST_CATCH_UP = 25  # steps; a machine that was away for longer does not run after lost time


class Pacing:
    """Paces periodic steps by a clock. Pure: times are arguments, in nanoseconds."""

    def __init__(self, period: int, now: int) -> None:
        self._period, self._epoch, self._done = period, now, 0
        self.misses = 0   # steps that began more than a period late
        self.skipped = 0  # periods of wall-clock time given up

    def due(self, now: int) -> int:
        """Return the number of steps that the caller is to execute at the time `now`."""
        behind = (now - self._epoch) // self._period - self._done
        if behind <= 0:
            return 0
        self.misses += behind - 1
        if behind > LONGEST_CATCH_UP:
            lost = behind - LONGEST_CATCH_UP
            self.skipped += lost
            self._epoch += lost * self._period
            behind = LONGEST_CATCH_UP
        self._done += behind
        return behind
