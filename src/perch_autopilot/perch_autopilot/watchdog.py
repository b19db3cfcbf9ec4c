"""What the autopilot receives when commands stop: level, descend, disarm. Without a clock: times are arguments."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from perch_core.config import quantity

STICKS = 4
CENTRED = (1500, 1500, 1000, 1500)
ON, OFF = 1900, 1000  # of a switch [us]
Channels = tuple[int, ...]


@dataclass(frozen=True, kw_only=True)
class WatchdogSettings:
    """When a command is stale, and what follows."""

    rate: float = quantity(200.0, unit="Hz", low=50.0, high=250.0, doc="of the frames to the autopilot, in every case")
    arming: float = quantity(0.2, unit="s", low=0.0, high=2.0, doc="the throttle stays down for this time after arming, as the firmware requires")
    stale_after: float = quantity(0.04, unit="s", low=0.02, high=0.25, doc="a command older than this is not sent; level instead")
    descend_after: float = quantity(0.5, unit="s", low=0.0, high=0.9, doc="time without a command until the descent")
    disarm_after: float = quantity(4.0, unit="s", low=0.5, high=60.0, doc="time without a command until the motors stop")
    descent: float = quantity(0.9, low=0.5, high=1.0, doc="thrust of the descent as a share of the weight")


class Mode(Enum):
    """Modes of the watchdog."""

    DISARMED = "disarmed"
    FOLLOWING = "following"
    LEVEL = "level: commands have stopped"
    DESCENDING = "descending: commands have stopped"


class Watchdog:
    """Decides which channels go to the autopilot: roll, pitch, throttle, yaw, then the switches arm and level.

    Attributes:
        mode: present mode.
    """

    def __init__(self, settings: WatchdogSettings, hover: int, descent: int) -> None:
        """
        Args:
            settings: times.
            hover, descent: throttle that carries the weight, and that of the descent [us].
        """
        self._settings = settings
        self.set_throttles(hover, descent)
        self.mode = Mode.DISARMED
        self._sticks: Channels = CENTRED
        self._wanted, self._came, self._since = False, 0.0, 0.0
        self._locked = False  # the motors were stopped: only a command to disarm allows arming again

    def set_throttles(self, hover: int, descent: int) -> None:
        """Set the throttles of hover and descent [us]; they rise as the battery empties."""
        self._hover, self._descent = hover, descent

    def command(self, now: float, armed: bool, sticks: Channels) -> None:
        """Take a command.

        Args:
            now: [s].
            armed: whether the motors shall turn.
            sticks: roll, pitch, throttle, yaw [us].
        """
        if armed and not self._wanted:
            self._since = now
        self._wanted, self._came, self._sticks = armed, now, sticks
        self._locked = self._locked and armed

    def channels(self, now: float) -> Channels:
        """Channels for the autopilot at a time [s], in us; never those of a stale command."""
        age = now - self._came
        limits = self._settings
        if not self._wanted or self._locked or age < 0.0:
            self.mode = Mode.DISARMED
        elif age <= limits.stale_after:
            self.mode = Mode.FOLLOWING
            return (*(self._sticks if now - self._since >= limits.arming else CENTRED), ON, OFF)
        elif age <= limits.disarm_after:
            self.mode = Mode.LEVEL if age <= limits.descend_after else Mode.DESCENDING
            return (1500, 1500, self._hover if self.mode is Mode.LEVEL else self._descent, 1500, ON, ON)
        else:
            self.mode, self._locked = Mode.DISARMED, True
        return (*CENTRED, OFF, OFF)
