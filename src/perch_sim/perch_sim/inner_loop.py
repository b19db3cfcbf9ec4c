"""Ideal rate or attitude loop in front of the rotors: first-order lags on the true state, and a mixer that saturates.

It uses the vehicle's file, the rotor speeds and the true rates. It compensates the rotors' lag: moment and thrust are reached
after one control period where the rotors permit. It is independent of `perch_control.inner_loop`, which has a model of it.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import Any

import numpy as np

from perch_core.errors import ConfigError
from perch_core.jit import compiled
from perch_core.registry import resolved
from perch_core.vehicle import Vehicle
from perch_sim.imu import ImuSample
from perch_sim.timing import CONTROL_PERIOD

FIRMWARE = "perch_autopilot.loop:FirmwareLoop"  # an optional extra, loaded where a vehicle names it


def inner_loop(vehicle: Vehicle, lag_factor: float, voltage_factor: float = 1.0) -> InnerLoop | Any:
    """Return the inner loop between commands and rotors; None for a vehicle that takes rotor speeds.

    Raises:
        ConfigError: a factor other than 1 that this vehicle does not use.
        PerchError: the vehicle's firmware is not installed, or does not start.
    """
    firmware = bool(vehicle.actuation.firmware)
    if voltage_factor != 1.0 and not firmware:
        raise ConfigError("", "disturbance.voltage_factor", f"{voltage_factor:g} has no effect on {vehicle.name}, which has no firmware")
    if lag_factor != 1.0 and (firmware or vehicle.actuation.type == "rotor_speeds"):
        raise ConfigError("", "disturbance.loop_lag_factor", f"{lag_factor:g} has no effect on {vehicle.name}, which has no ideal inner loop")
    if vehicle.actuation.type == "rotor_speeds":
        return None
    return resolved(FIRMWARE)(vehicle, voltage_factor) if firmware else InnerLoop(vehicle, lag_factor)


@compiled
def mixed(thrust, moment, mixing, low, high):
    """Return rotor thrusts within their bounds, by priority: roll and pitch, scaled together; yaw, scaled; thrust, clamped.

    Args:
        thrust: collective thrust [N].
        moment: moment in B [N m], (3,).
        mixing: matrix from (thrust, moments) to rotor thrusts, (4, 4).
        low, high: thrust bounds of a rotor [N].

    Returns:
        (4,) [N].
    """
    tilt = mixing[:, 1] * moment[0] + mixing[:, 2] * moment[1]
    span = tilt.max() - tilt.min()
    if span > high - low:
        tilt *= (high - low) / span
    yaw, share = mixing[:, 3] * moment[2], 1.0
    for i in range(4):
        for j in range(4):
            if yaw[i] - yaw[j] > 1e-12:
                share = min(share, max((high - low - tilt[i] + tilt[j]) / (yaw[i] - yaw[j]), 0.0))
    turn = tilt + share * yaw
    least, most = ((low - turn) / mixing[:, 0]).max(), ((high - turn) / mixing[:, 0]).min()
    return np.minimum(np.maximum(turn + mixing[:, 0] * min(max(thrust, least), most), low), high)


@compiled
def rates_of_attitude(q, wanted, rates, lag):
    """Return an attitude loop's commanded rates: fed-forward rates + rotation to the wanted attitude / `lag`, (3,) [rad/s]."""
    # conj(q) * wanted, on the short way round.
    w = q[3] * wanted[3] + q[0] * wanted[0] + q[1] * wanted[1] + q[2] * wanted[2]
    x = q[3] * wanted[0] - q[0] * wanted[3] - q[1] * wanted[2] + q[2] * wanted[1]
    y = q[3] * wanted[1] - q[1] * wanted[3] - q[2] * wanted[0] + q[0] * wanted[2]
    z = q[3] * wanted[2] - q[2] * wanted[3] - q[0] * wanted[1] + q[1] * wanted[0]
    length = math.sqrt(x * x + y * y + z * z)
    k = 2.0 * math.atan2(length, abs(w)) / max(length, 1e-12) * (1.0 if w >= 0.0 else -1.0) / lag
    return rates + k * np.array((x, y, z))


@compiled
def targets(w, speeds, rates, thrust, J, mixing, coefficient, low, high, motor_lag, lags, period):
    """Return the target speeds of the motors, (4,) [rad/s].

    Args:
        w: body rates (3,) [rad/s].
        speeds: rotor speeds (4,) [rad/s].
        rates, thrust: wanted body rates (3,) [rad/s] and collective thrust [N].
        J: principal moments of inertia (3,) [kg m^2].
        mixing, coefficient, low, high: mixing matrix, thrust coefficient, least and greatest speed [rad/s] of the rotors.
        motor_lag: time constant of the rotors [s].
        lags: time constants of the rates and the thrust (4,) [s].
        period: interval between two calls [s].
    """
    moment = J * (rates - w) / lags[:3]
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        moment[i] += (J[k] - J[j]) * w[j] * w[k]
    now = coefficient * (speeds * speeds).sum()
    f = mixed(now + (thrust - now) * (1.0 - math.exp(-period / lags[3])), moment, mixing, coefficient * low * low,
              coefficient * high * high)
    wanted = np.sqrt(f / coefficient)
    if motor_lag > 0.0:
        wanted = speeds + (wanted - speeds) / (1.0 - math.exp(-period / motor_lag))
    return np.minimum(np.maximum(wanted, low), high)


class InnerLoop:
    """Converts body rates, or attitudes, and thrust to target speeds of the motors.

    Attributes:
        handles_command_timeout: whether the loop itself handles commands that stop; this one leaves them to the motors' time-out.
    """

    handles_command_timeout = False

    def __init__(self, vehicle: Vehicle, lag_factor: float = 1.0) -> None:
        """
        Args:
            vehicle: vehicle with the parameters of its loop.
            lag_factor: lags of the true loop / those of the vehicle's file.
        """
        a = vehicle.actuation
        self._delay, self._lags = round(a.delay * 1e9), lag_factor * np.array([*a.rate_lag, a.thrust_lag])
        self._gain, self._rate_max, self._attitude_lag = np.array([*a.rate_gain, a.thrust_gain]), a.rate_max, lag_factor * a.attitude_lag
        self._mass = vehicle.mass
        self._rotors = (np.array(vehicle.inertia), np.linalg.inv(vehicle.allocation), vehicle.thrust_coefficient, vehicle.speed_min,
                        vehicle.speed_max, vehicle.motor_time_constant)
        self._pending: deque[tuple[int, np.ndarray, np.ndarray | None]] = deque()
        self._rates = np.zeros(4)
        self._attitude: np.ndarray | None = None

    def command(self, now: int, armed: bool, rates: Sequence[float], thrust: float, attitude: Sequence[float] | None = None) -> None:
        """Accept a command at a time [ns]: body rates [rad/s], thrust / mass [m/s^2], attitude xyzw for an attitude loop.
        A command that is not armed cancels all earlier ones."""
        if not armed:
            self._pending.clear()
            self._rates, self._attitude = np.zeros(4), None
            return
        values = np.array([*rates, thrust * self._mass], float)
        self._pending.append((now + self._delay, values, None if attitude is None else np.array(attitude, float)))

    def speeds(self, now: int, x: np.ndarray, speeds: np.ndarray, sample: ImuSample | None = None) -> np.ndarray:
        """Return the target speeds of the motors for the period that begins now, (4,) [rad/s].

        Args:
            now: simulation time [ns].
            x: true state (13,), see `dynamics`.
            speeds: rotor speeds (4,) [rad/s].
            sample: last sample of the IMU; not used, as this loop has the true state.
        """
        while self._pending and self._pending[0][0] <= now:
            _, self._rates, self._attitude = self._pending.popleft()
        rates = self._rates[:3] if self._attitude is None else rates_of_attitude(x[3:7], self._attitude, self._rates[:3],
                                                                                 self._attitude_lag)
        rates = self._gain[:3] * np.clip(rates, -self._rate_max, self._rate_max)
        return targets(x[10:13], speeds, rates, self._gain[3] * self._rates[3], *self._rotors, self._lags, CONTROL_PERIOD)

    def close(self) -> None:
        """Do nothing: the loop holds no resources."""
