"""Plausibility check of a stream's stamps: they must increase in steps of at most `JUMP`, unless the stream has restarted."""

from __future__ import annotations

import enum

JUMP = 1_000_000_000        # a stamp further from the last one may be that of a restarted stream [ns]
RESTART_CONFIRMATIONS = 10  # consecutive consistent stamps after which the stream counts as restarted


class StampVerdict(enum.Enum):
    """Result of the check of a stamp."""

    GOOD = "follows the last one"
    REFUSED = "does not follow the last one"
    RESTARTED = "the stream has restarted"


class StampGuard:
    """Checks the stamps of one stream, in the order of their arrival.

    One wrong stamp must not invalidate those after it, and a source that was restarted (or whose clock was set) must be accepted
    again. A stamp further than `JUMP` from the last one is therefore refused until `RESTART_CONFIRMATIONS` in a row are consistent
    with each other. One that goes back by less is always refused: it was delivered late, or the clock will soon pass the last one.

    Attributes:
        last: the last accepted stamp [ns]; None before the first.
    """

    __slots__ = ("last", "_candidate", "_consistent_count")

    def __init__(self) -> None:
        self.last: int | None = None
        self._candidate, self._consistent_count = 0, 0

    def check(self, stamp: int) -> StampVerdict:
        """Check a stamp [ns]."""
        last = self.last
        if last is None or abs(stamp - last) <= JUMP:
            self._consistent_count = 0
            if last is not None and stamp <= last:
                return StampVerdict.REFUSED
            self.last = stamp
            return StampVerdict.GOOD
        follows = self._consistent_count > 0 and 0 < stamp - self._candidate <= JUMP
        self._consistent_count = self._consistent_count + 1 if follows else 1
        self._candidate = stamp
        if self._consistent_count < RESTART_CONFIRMATIONS:
            return StampVerdict.REFUSED
        self.last, self._consistent_count = stamp, 0
        return StampVerdict.RESTARTED
