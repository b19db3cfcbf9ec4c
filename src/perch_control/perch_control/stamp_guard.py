"""Check of stamps against the present time, for IMU and odometry together, so that one faulty publisher cannot shift the time."""

from __future__ import annotations

from enum import Enum

_JUMP = 1_000_000_000    # further behind the newest stamp than this, a stamp is not current [ns] ...
_AHEAD = 80_000_000      # the same ahead of it [ns] ...
_CONFIRM = 50_000_000    # ... unless only such stamps, consistent with each other, have arrived for so long [ns]


class Stamp(Enum):
    """Verdict on a stamp."""

    CURRENT = "current"
    REFUSED = "not current"
    AHEAD = "time has jumped ahead"
    RESTARTED = "time has restarted"


class StampGuard:
    """Owns the newest stamp of several streams of the same clock.

    Attributes:
        newest: the newest accepted stamp [ns], 0 without one.
        initialised: whether a stamp has been accepted.
    """

    def __init__(self) -> None:
        self.newest, self.initialised = 0, False
        self._first = self._last = -1  # first and last of consecutive stamps that are not current [ns]

    def check(self, stamp: int, may_restart: bool = True) -> Stamp:
        """Check a stamp [ns] of any of the streams.

        Args:
            stamp: stamps are passed in the order of arrival; one slightly older than the newest is accepted, too.
            may_restart: whether time may restart; otherwise stamps of the past are always refused.
        """
        newest = self.newest
        if not self.initialised or -_JUMP <= stamp - newest <= _AHEAD:
            self._first = -1
            self.newest, self.initialised = max(stamp, newest) if self.initialised else stamp, True
            return Stamp.CURRENT
        if self._first < 0 or not 0 <= stamp - self._last <= _JUMP:
            self._first = stamp
        self._last = stamp
        if stamp - self._first < _CONFIRM or (stamp < newest and not may_restart):
            return Stamp.REFUSED
        self.newest, self._first = stamp, -1
        return Stamp.AHEAD if stamp > newest else Stamp.RESTARTED
