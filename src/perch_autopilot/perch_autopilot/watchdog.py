"""Channels for the autopilot when commands stop: level, descend, disarm; on the ground idle, disarm. Times are arguments."""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum

from perch_autopilot.levelling import ATTITUDE_MAX_AGE, TILT_THRESHOLD, sticks, tilt, up
from perch_autopilot.rate_curve import RateCurve

CENTRED = (1500, 1500, 1000, 1500)
ON, OFF = 1900, 1000  # of a switch [us]
ARMING = 0.2         # the throttle stays down for this time after arming, as the firmware requires [s]
STALE_AFTER = 0.04   # a command older than this is not sent; level instead [s]
DESCEND_AFTER = 0.5  # time without a command until the descent, on the ground until the motors stop [s]
DISARM_AFTER = 4.0   # ... and until the motors stop, by default [s]
DESCENT = 0.9        # thrust of the descent as a share of the weight
ROTATION_DEFLECTION = 100  # of a stick from its centre: larger than any rate command at idle, which follows the gyroscope [us]
Channels = tuple[int, ...]


class Mode(Enum):
    """Modes of the watchdog."""

    DISARMED = "disarmed"
    FOLLOWING = "following"
    IDLE = "idle: commands have stopped on the ground"
    LEVEL = "level: commands have stopped"
    DESCENDING = "descending: commands have stopped"


def lifts(sticks: Channels, hover: int) -> bool:
    """Return whether sticks [us] command lift: more than half of the hover throttle, or a rotation beyond `ROTATION_DEFLECTION`."""
    roll, pitch, throttle, yaw = sticks
    return (2 * (throttle - CENTRED[2]) > hover - CENTRED[2]
            or max(abs(stick - CENTRED[0]) for stick in (roll, pitch, yaw)) > ROTATION_DEFLECTION)


class Watchdog:
    """Selects the channels that are sent to the autopilot: roll, pitch, throttle, yaw, then the switches arm and level.

    Attributes:
        mode: present mode.
        command_received: whether a command was received; until then nothing should be sent, as the vehicle may be in flight.
    """

    def __init__(self, hover: int, descent: int, disarm_after: float = DISARM_AFTER, arming: float = ARMING,
                 curves: Sequence[RateCurve] = ()) -> None:
        """
        Args:
            hover, descent: throttle that carries the weight, and that of the descent [us].
            disarm_after, arming: times [s], see `DISARM_AFTER`, `ARMING`.
            curves: rate curves of roll and pitch, for levelling by rates; empty: the autopilot's self-level mode alone is used.
        """
        self._curves, self._disarm_after, self._arming = curves, disarm_after, arming
        self._up, self._attitude_time = (0.0, 0.0, 1.0), -1e9  # in B, and its time [s]
        self.set_throttles(hover, descent)
        self.mode = Mode.DISARMED
        self._sticks: Channels = CENTRED
        self._armed_command, self._command_time, self._armed_since = False, 0.0, -1e9
        self.command_received = self._motors_turning = False
        self._lifted = False  # a command since arming has commanded lift
        self._locked = False  # the motors were stopped: only a command to disarm allows arming again

    def set_throttles(self, hover: int, descent: int) -> None:
        """Set the throttles of hover and descent [us], which rise as the battery discharges."""
        self._hover, self._descent = hover, descent

    def attitude(self, now: float, roll: float, pitch: float) -> None:
        """Record the autopilot's attitude at a time [s]: roll and pitch of FRD against NED [rad]."""
        self._up, self._attitude_time = up(roll, pitch), now

    def needs_attitude(self, now: float) -> bool:
        """Return whether the autopilot's attitude must be requested at a time [s], for levelling by rates: commands are late."""
        return bool(self._curves) and self._armed_command and now - self._command_time > 0.5 * STALE_AFTER

    def report_motors_turning(self) -> None:
        """Report motors that turn already: the first command is followed without the delay `ARMING`; the vehicle may fly."""
        self._motors_turning = self._lifted = True

    def command(self, now: float, armed: bool, sticks: Channels) -> None:
        """Record a command.

        A descent without commands is ended by a command with the motors on, not by one with the motors off: a controller that was
        started again in flight is disarmed.

        Args:
            now: time [s].
            armed: whether the motors are to turn.
            sticks: roll, pitch, throttle, yaw [us].
        """
        if not armed and self.mode is Mode.DESCENDING:
            return
        if armed and not (self._armed_command or self._motors_turning):
            self._armed_since = now
        self._armed_command, self._command_time, self._sticks = armed, now, sticks
        self.command_received, self._motors_turning = True, False
        self._lifted = armed and (self._lifted or lifts(sticks, self._hover))
        self._locked = self._locked and armed

    def kill(self) -> None:
        """Stop the motors, also in a descent without commands, until a command to disarm."""
        self._locked = self.command_received = True

    def channels(self, now: float) -> Channels:
        """Return the channels for the autopilot at a time [s], in us, and set `mode`; stale commands are never returned."""
        age = now - self._command_time
        if not self._armed_command or self._locked or age < 0.0:
            self.mode = Mode.DISARMED
        elif age <= STALE_AFTER:
            self.mode = Mode.FOLLOWING
            return (*(self._sticks if now - self._armed_since >= self._arming else CENTRED), ON, OFF)
        elif not self._lifted and age <= DESCEND_AFTER:
            self.mode = Mode.IDLE
            return (*CENTRED, ON, OFF)
        elif self._lifted and age <= self._disarm_after:
            self.mode = Mode.LEVEL if age <= DESCEND_AFTER else Mode.DESCENDING
            throttle = self._hover if self.mode is Mode.LEVEL else self._descent
            if self._curves and 0.0 <= now - self._attitude_time <= ATTITUDE_MAX_AGE and tilt(self._up) > TILT_THRESHOLD:
                return (*sticks(self._up, self._curves), throttle, 1500, ON, OFF)
            return (1500, 1500, throttle, 1500, ON, ON)
        else:
            self.mode, self._locked = Mode.DISARMED, True
        return (*CENTRED, OFF, OFF)
