"""Check of stamps against the present time, for IMU and odometry together, so that one faulty publisher cannot shift the time."""

from __future__ import annotations

from enum import Enum

_JUMP = 1_000_000_000    # further behind the newest stamp than this, a stamp is not current [ns] ...
_AHEAD = 80_000_000      # the same ahead of it [ns] ...
_CONFIRM = 50_000_000    # ... unless one stream has had such stamps, increasing, for so long, and none was current [ns]


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
        self._unconfirmed: dict[str, tuple[int, int]] = {}  # stream -> first and last of its stamps that are not current [ns]

    def check(self, stamp: int, stream: str, may_restart: bool = True) -> Stamp:
        """Check a stamp.

        Args:
            stamp: in the order of arrival [ns]; one slightly older than the newest is accepted, too.
            stream: name of its stream. Streams may be read one after the other, in batches.
            may_restart: whether time may restart; otherwise stamps of the past are always refused.
        """
        newest = self.newest
        if not self.initialised or -_JUMP <= stamp - newest <= _AHEAD:
            self._unconfirmed.clear()
            self.newest, self.initialised = max(stamp, newest) if self.initialised else stamp, True
            return Stamp.CURRENT
        first, last = self._unconfirmed.get(stream, (stamp, stamp))
        if not 0 <= stamp - last <= _JUMP:
            first = stamp
        self._unconfirmed[stream] = first, stamp
        if stamp - first < _CONFIRM or (stamp < newest and not may_restart):
            return Stamp.REFUSED
        self.newest = stamp
        self._unconfirmed.clear()
        return Stamp.AHEAD if stamp > newest else Stamp.RESTARTED
