"""Check of stamps against the present time, for IMU and odometry together, so that one faulty publisher cannot shift the time."""

from __future__ import annotations

from enum import Enum

_JUMP = 1_000_000_000    # further behind the newest stamp than this, a stamp is not of the present [ns] ...
_AHEAD = 80_000_000      # further ahead of it, no stamp of running streams is [ns] ...
_CONFIRM = 50_000_000    # ... unless nothing but such stamps has come for so long by themselves [ns]


class Stamp(Enum):
    """Verdict on a stamp."""

    PRESENT = "of the present"
    REFUSED = "not of the present"
    AHEAD = "time has jumped ahead"
    ANEW = "time has begun anew"


class StampGuard:
    """Owns the newest stamp of several streams of the same clock.

    Attributes:
        newest: the newest accepted stamp [ns], 0 without one.
        begun: whether a stamp has been accepted.
    """

    def __init__(self) -> None:
        self.newest, self.begun = 0, False
        self._first = self._last = -1  # of stamps that are away from the newest, with nothing else between them

    def judge(self, stamp: int, may_restart: bool = True) -> Stamp:
        """Check a stamp [ns] of any of the streams.

        Args:
            stamp: stamps are passed in the order of arrival; one slightly older than the newest is accepted, too.
            may_restart: whether time may restart; otherwise stamps of the past are always refused.
        """
        newest = self.newest
        if not self.begun or -_JUMP <= stamp - newest <= _AHEAD:
            self._first = -1
            self.newest, self.begun = max(stamp, newest) if self.begun else stamp, True
            return Stamp.PRESENT
        if self._first < 0 or not 0 <= stamp - self._last <= _JUMP:
            self._first = stamp
        self._last = stamp
        if stamp - self._first < _CONFIRM or (stamp < newest and not may_restart):
            return Stamp.REFUSED
        self.newest, self._first = stamp, -1
        return Stamp.AHEAD if stamp > newest else Stamp.ANEW
