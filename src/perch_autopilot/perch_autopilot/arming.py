"""Who has stopped the motors, and whether commands may start them. Pure: times are arguments."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

LATENCY = 0.2  # a report that follows a command by less may be older than it [s]


class Stop(Enum):
    """What keeps the motors off although commands have them on."""

    START = "this node was started"
    KILL = "KILL was received"
    AUTOPILOT = "the autopilot was disarmed by its pilot, its failsafe or a restart"
    WATCHDOG = "commands had stopped"


@dataclass
class Arming:
    """Whether commands with the motors on are obeyed.

    A stop ends only when commands have the motors off and the autopilot has been disarmed since: the next command with the motors
    on is then a fresh request. The start of the node is a stop unless the autopilot is armed, as a KILL before it is not known.

    Attributes:
        stop: the present stop; None: commands are obeyed.
        wanted: whether the last command has the motors on; None: there was none since the stop.
    """

    stop: Stop | None = None
    wanted: bool | None = None
    _was_armed: bool = False        # reported while commands with the motors on were obeyed
    _disarmed: bool = False         # reported since the stop
    _disarmed_reports: int = 0      # in a row
    _last_off: float = -1e9         # time of the last command with the motors off [s]

    def start(self, armed: bool) -> None:
        """Record whether the autopilot is armed when the node starts: what flies then is flown on."""
        if not armed:
            self.halt(Stop.START)
            self._disarmed = True

    def halt(self, stop: Stop) -> None:
        """Record a stop, to which the commands and reports until now do not belong."""
        self.stop, self.wanted, self._was_armed, self._disarmed = stop, None, False, False

    def command(self, now: float, armed: bool) -> bool:
        """Record a command at a time [s]; return whether it is obeyed."""
        self.wanted = armed
        if not armed:
            self._was_armed, self._last_off = False, now
            self._release()
        return self.stop is None or not armed

    def report(self, now: float, armed: bool, needed: int = 1, stop: Stop = Stop.AUTOPILOT) -> bool:
        """Record a report of the autopilot.

        Args:
            now: time [s].
            armed: whether it is armed.
            needed: reports in a row that it is disarmed, though it was armed, from which a stop follows: one may be corrupt.
            stop: who disarms it where commands do not.

        Returns:
            Whether it has been disarmed by `stop`.
        """
        self._disarmed_reports = 0 if armed else self._disarmed_reports + 1
        if armed:
            self._was_armed |= self.stop is None and bool(self.wanted) and not 0.0 <= now - self._last_off < LATENCY
        elif self._was_armed and self._disarmed_reports >= needed:
            self.halt(stop)
            self._disarmed = True
            return True
        self._disarmed |= not armed
        self._release()
        return False

    @property
    def in_doubt(self) -> bool:
        """Whether reports have it disarmed, but not yet often enough."""
        return self._was_armed and self._disarmed_reports > 0

    def _release(self) -> None:
        if self.wanted is False and self._disarmed:
            self.stop = None
