"""Inner loop of the simulated vehicle by Betaflight's firmware: body rates and thrust in, target speeds of the motors out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from perch_core.values import NANOSECONDS
from perch_core.vehicle import Vehicle
from perch_autopilot.configuration import load_configuration
from perch_autopilot.firmware import FirmwareError
from perch_autopilot.rates import Sticks, rate_curves
from perch_autopilot.sitl import GRAVITY, LEVEL, Sitl
from perch_autopilot.watchdog import CENTRED, DESCENT, OFF, ON, Watchdog

_SETTLED = 500            # cycles on the bench before it is armed: a new radio signal is accepted after half a second
_LAST = 500               # cycles on the bench within which it must arm
_STILL = (0.0, 0.0, 0.0)


class Reading(Protocol):
    """Sample of an IMU: specific force [m/s^2] and angular velocity [rad/s] in B, (3,) each."""

    accel: np.ndarray
    gyro: np.ndarray


class FirmwareLoop:
    """Runs the firmware as the autopilot of the simulated vehicle, with the samples of its IMU, and stick and switch positions.

    When commands stop, the watchdog replaces them, as on a vehicle. The constructor arms and disarms the firmware once, at rest.

    Attributes:
        sitl: the firmware.
        watchdog: replaces commands that stop.
        handles_command_timeout: the loop itself handles commands that stop, instead of the motors' time-out.
    """

    handles_command_timeout = True

    def __init__(self, vehicle: Vehicle, voltage_factor: float = 1.0) -> None:
        """
        Args:
            vehicle: vehicle whose rotors are driven; `actuation.firmware` names the configuration.
            voltage_factor: battery voltage / that of the vehicle's thrust curve; rotor speeds are proportional to it.

        Raises:
            FirmwareError: the firmware is not installed, or does not arm.
            NamespaceError, CliError, ConfigError: see `Sitl`, `load_configuration`.
        """
        loaded = load_configuration(vehicle.actuation.firmware)
        self.sticks = Sticks(vehicle, rate_curves(loaded.settings, loaded.source))
        self.sticks.set_voltage(voltage_factor * vehicle.actuation.battery.reference)
        self._voltage_factor = voltage_factor
        # No delay after arming: `channels` raises the throttle only when the motors turn.
        self.watchdog = Watchdog(self.sticks.throttle_for(1.0), self.sticks.throttle_for(DESCENT), arming=0.0)
        self._low, self._span = vehicle.speed_min, vehicle.speed_max - vehicle.speed_min
        self._idle = float(loaded.settings.get("motor_idle", 550)) * 1e-4  # motors of an armed vehicle with the throttle down
        self._turning = False
        self.sitl = Sitl(loaded)
        try:
            for _ in range(_SETTLED):
                self._bench(OFF, "disarm")
            self._bench(ON, "arm")
            self._bench(OFF, "disarm")
        except BaseException:
            self.sitl.close()
            raise

    def _bench(self, switch: int, what: str) -> None:
        """Run the firmware at rest until its motors turn (switch on) or stand still (switch off)."""
        for _ in range(_LAST):
            motors = self.sitl.step(_STILL, GRAVITY, LEVEL, (*CENTRED, switch))
            if min(motors) > 0.5 * self._idle if switch == ON else max(motors) == 0.0:
                return
        reasons = ", ".join(self.sitl.status().refusals) or "no reason given"
        raise FirmwareError(f"Betaflight's firmware does not {what}: {reasons}")

    def command(self, now: int, armed: bool, rates: Sequence[float], thrust: float) -> None:
        """Accept a command at a time [ns]: body rates in B [rad/s], collective thrust / mass [m/s^2]."""
        self.watchdog.command(now / NANOSECONDS, armed, self.sticks.channels(rates, thrust) if armed else CENTRED)

    def speeds(self, now: int, x: np.ndarray, speeds: np.ndarray, sample: Reading) -> np.ndarray:
        """Return the target speeds of the rotors for the period that begins now [ns], shape (4,) [rad/s]; zero if they stand.

        Args:
            now, x, speeds: as in `perch_sim.inner_loop`; of the state, only the orientation is sent to the firmware; its rate
                loop does not use it.
            sample: last sample of the IMU.
        """
        motors = np.asarray(self.sitl.step(sample.gyro, sample.accel, (x[6], x[3], x[4], x[5]), self.channels(now / NANOSECONDS)))
        turn = motors > 0.5 * self._idle
        self._turning = bool(turn.all())
        throttle = np.clip((motors - self._idle) / (1.0 - self._idle), 0.0, 1.0)
        return np.where(turn, self._voltage_factor * (self._low + self._span * throttle), 0.0)

    def channels(self, now: float) -> Sequence[int]:
        """Return the channels for the firmware at a time [s], as pulse widths [us]."""
        channels = self.watchdog.channels(now)
        return channels if self._turning else (*CENTRED, *channels[len(CENTRED):])  # it arms with the throttle down only

    def close(self) -> None:
        """End the firmware."""
        self.sitl.close()
