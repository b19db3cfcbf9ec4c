"""Motor controllers: arming, limits of commands, and stop when commands cease."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from perch_core.errors import PerchError
from perch_core.values import MotorCommand, limits

_SPEEDS = limits.LIMITS[MotorCommand]["rotor_speed"]


class MotorCommandError(PerchError):
    """Raised when a command is refused."""


class Motors:
    """Holds the last valid command, and provides the target speeds of the rotors.

    Attributes:
        timeout: time without a valid command after which armed motors stop [ns].
        timed_out: whether the motors have stopped for this reason.
        starts: number of starts, except those directly after a time-out.
    """

    def __init__(self, speed_min: float, speed_max: float, timeout: int) -> None:
        """
        Args:
            speed_min, speed_max: speed range of an armed rotor [rad/s].
            timeout: as above.
        """
        self._low, self._high, self.timeout = speed_min, speed_max, timeout
        self._speeds, self._armed, self._received = np.zeros(4), False, 0
        self.timed_out, self.starts = False, 0

    def command(self, now: int, armed: bool, speeds: Sequence[float]) -> None:
        """Accept a command.

        Args:
            now: simulation time [ns].
            armed: false stops the motors.
            speeds: rotor speeds (4,) [rad/s], limited to the armed range.

        Raises:
            MotorCommandError: a speed is invalid, or there are not four; the previous command stays in effect until it times out.
        """
        values = [float(s) for s in speeds]
        if len(values) != 4:
            raise MotorCommandError(f"motor_command: rotor_speed has {len(values)} entries, needs 4")
        if armed and not all(abs(s) <= _SPEEDS.high for s in values):
            raise MotorCommandError(f"motor_command: rotor_speed: {_SPEEDS.problem(np.abs(values))}")
        self.starts += armed and not self._armed and not self.timed_out
        self._armed, self._received, self.timed_out = armed, now, False
        if armed:
            self._speeds = np.array([min(max(s, self._low), self._high) for s in values])

    def aim(self, speeds: np.ndarray) -> None:
        """Set the target speeds of an inner loop, within the armed range (4,) [rad/s]; they are valid as long as the last command."""
        self._speeds = speeds

    def target(self, now: int) -> np.ndarray:
        """Return the target speeds of the rotors, (4,) [rad/s]; zero if the motors are stopped."""
        if self._armed and now - self._received > self.timeout:
            self._armed, self.timed_out = False, True
        return self._speeds if self._armed else np.zeros(4)
