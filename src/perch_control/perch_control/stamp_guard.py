"""Check of stamps against the present time, for IMU and odometry together, so that one faulty publisher cannot shift the time."""

from __future__ import annotations

from enum import Enum

_JUMP = 1_000_000_000    # further behind the newest stamp than this, a stamp is not current [ns] ...
_STEP = 80_000_000       # the same ahead of the newest or, without a restart, behind the newest of its own stream [ns] ...
_CONFIRM = 50_000_000    # ... unless one stream has had such stamps, increasing, for so long, and none was current [ns]


class Stamp(Enum):
    """Verdict on a stamp."""

    CURRENT = "current"
    REFUSED = "not current"
    AHEAD = "time has jumped ahead"
    SET_BACK = "time has been set back"
    RESTARTED = "time has restarted"


class StampGuard:
    """Owns the newest stamp of several streams of the same clock.

    Attributes:
        newest: the newest accepted stamp [ns], 0 without one.
        initialised: whether a stamp has been accepted.
        set_back: by how much time has been set back altogether since it began or restarted: stamp + set_back never steps back [ns].
    """

    def __init__(self) -> None:
        self.newest, self.initialised, self.set_back = 0, False, 0
        self._last: dict[str, int] = {}  # stream -> its newest accepted stamp [ns]
        self._unconfirmed: dict[str, tuple[int, int]] = {}  # stream -> first and last of its stamps that are not current [ns]

    def check(self, stamp: int, stream: str, may_restart: bool = True) -> Stamp:
        """Check a stamp.

        Args:
            stamp: in the order of arrival [ns]; one slightly older than the newest is accepted, too.
            stream: name of its stream. Streams may be read one after the other, in batches.
            may_restart: whether stamps of the past may be those of a restart; otherwise the clock has been set back, and time goes on.
        """
        newest = self.newest
        if not self.initialised or -_JUMP <= stamp - newest <= _STEP and (may_restart or stamp >= self._last.get(stream, stamp) - _STEP):
            self._unconfirmed.clear()
            self._last[stream] = max(stamp, self._last.get(stream, stamp))
            self.newest, self.initialised = max(stamp, newest) if self.initialised else stamp, True
            return Stamp.CURRENT
        first, last = self._unconfirmed.get(stream, (stamp, stamp))
        if not 0 <= stamp - last <= _JUMP:
            first = stamp
        self._unconfirmed[stream] = first, stamp
        if stamp - first < _CONFIRM:
            return Stamp.REFUSED
        self.newest, self._last = stamp, {stream: stamp}
        self._unconfirmed.clear()
        if stamp > newest:
            return Stamp.AHEAD
        self.set_back = 0 if may_restart else self.set_back + newest - first
        return Stamp.RESTARTED if may_restart else Stamp.SET_BACK
