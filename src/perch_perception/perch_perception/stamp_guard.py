"""Plausibility check of a stream's stamps: they must increase in steps of at most `JUMP`, unless the stream has restarted."""

from __future__ import annotations

import enum

JUMP = 1_000_000_000  # a stamp further ahead of the last one is not its successor [ns]
PATIENCE = 10         # as many in a row that follow each other, but not the last one believed, are a stream that has started anew


class StampVerdict(enum.Enum):
    """Result of the check of a stamp."""

    GOOD = "follows the last one"
    REFUSED = "does not follow the last one"
    RESTARTED = "the stream has started anew"


class StampGuard:
    """Checks the stamps of one stream, in the order of their arrival.

    One wrong stamp must not invalidate those after it, and a source that was restarted (or whose clock was set) must be accepted
    again. A stamp that goes back, or jumps ahead, is therefore refused until `PATIENCE` in a row are consistent with each other.

    Attributes:
        last: the last accepted stamp [ns]; None before the first.
    """

    __slots__ = ("last", "_other", "_agreeing")

    def __init__(self) -> None:
        self.last: int | None = None
        self._other, self._agreeing = 0, 0

    def judge(self, stamp: int) -> StampVerdict:
        """Check a stamp [ns]."""
        last = self.last
        if last is None or 0 < stamp - last <= JUMP:
            self.last, self._agreeing = stamp, 0
            return StampVerdict.GOOD
        follows = self._agreeing > 0 and 0 < stamp - self._other <= JUMP
        self._agreeing = self._agreeing + 1 if follows else 1
        self._other = stamp
        if self._agreeing < PATIENCE:
            return StampVerdict.REFUSED
        self.last, self._agreeing = stamp, 0
        return StampVerdict.RESTARTED
