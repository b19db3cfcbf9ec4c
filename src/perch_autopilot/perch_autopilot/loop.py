"""The simulated vehicle's inner loop by Betaflight's firmware: body rates and thrust in, what the motors aim at out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from perch_core.vehicle import Vehicle
from perch_autopilot.configuration import load_configuration
from perch_autopilot.firmware import FirmwareError
from perch_autopilot.rates import Sticks, rate_curves
from perch_autopilot.sitl import GRAVITY, LEVEL, STARTS, Sitl
from perch_autopilot.watchdog import CENTRED, OFF, ON

_TOGGLE, _LAST = 600, 20000    # cycles from one attempt to arm to the next, and in all: calibrations last 4000
_STILL = (0.0, 0.0, 0.0)


class Reading(Protocol):
    """Of an IMU: specific force [m/s^2] and angular velocity [rad/s] in B, (3,) each."""

    accel: np.ndarray
    gyro: np.ndarray


class FirmwareLoop:
    """Flies the simulated vehicle as its autopilot: it sees what the IMU reads, and moves sticks and switches.

    Before the flight it stands on a bench, until the firmware has calibrated its sensors and has armed once.
    """

    def __init__(self, vehicle: Vehicle) -> None:
        """
        Args:
            vehicle: whose rotors it drives; `actuation.firmware` names the configuration.

        Raises:
            FirmwareError: the firmware is not there, or does not arm.
            NamespaceError, CliError, ConfigError: see `Sitl`, `load_configuration`.
        """
        loaded = load_configuration(vehicle.actuation.firmware)
        self._sticks = Sticks(vehicle, rate_curves(loaded.settings, loaded.source))
        self._low, self._span = vehicle.speed_min, vehicle.speed_max - vehicle.speed_min
        self._idle = float(loaded.settings.get("motor_idle", 550)) * 1e-4  # motors of an armed vehicle with the throttle down
        self._armed, self._turning, self._channels = False, False, CENTRED
        for start in range(1, STARTS + 1):
            self.sitl = Sitl(loaded)
            try:
                self._arm_once()
                return
            except BaseException as error:
                self.sitl.close()
                if not isinstance(error, FirmwareError) or start == STARTS:  # now and then it starts with a sensor that it does not believe
                    raise

    def _arm_once(self) -> None:
        for cycle in range(_LAST):
            if min(self._cycle(cycle % _TOGGLE > _TOGGLE // 2)) > 0.5 * self._idle:
                break
        else:
            raise FirmwareError("Betaflight's firmware does not arm: " + ", ".join(self.sitl.status().refusals))
        for _ in range(_TOGGLE):
            motors = self._cycle(False)
        if max(motors) > 0.0:
            raise FirmwareError("Betaflight's firmware does not disarm")

    def _cycle(self, armed: bool) -> tuple[float, ...]:
        return self.sitl.step(_STILL, GRAVITY, LEVEL, (*CENTRED, ON if armed else OFF))

    def command(self, now: int, armed: bool, rates: Sequence[float], thrust: float) -> None:
        """Take a command: body rates in B [rad/s], collective thrust / mass [m/s^2]."""
        self._armed, self._channels = armed, self._sticks.channels(rates, thrust)

    def speeds(self, now: int, x: np.ndarray, speeds: np.ndarray, sample: Reading) -> np.ndarray:
        """Rotor speeds that the motors aim at in the period that begins now, shape (4,) [rad/s]; zero where they stand.

        Args:
            now, x, speeds: as in `perch_sim.inner_loop`; of the state only the orientation goes to the firmware, whose rate loop does not
                look at it.
            sample: what the IMU has read last.
        """
        sticks = self._channels if self._armed and self._turning else CENTRED  # it arms with the throttle down only
        motors = np.array(self.sitl.step(sample.gyro, sample.accel, (x[6], x[3], x[4], x[5]), (*sticks, ON if self._armed else OFF)))
        turn = motors > 0.5 * self._idle
        self._turning = bool(turn.all())
        return np.where(turn, self._low + self._span * np.clip((motors - self._idle) / (1.0 - self._idle), 0.0, 1.0), 0.0)

    def close(self) -> None:
        """End the firmware."""
        self.sitl.close()
