"""From body rates and thrust to a pilot's sticks: the firmware's rate curve, and the vehicle's thrust curve, backwards."""

from __future__ import annotations

from math import degrees, sqrt

from perch_core.arrays import Numbers
from perch_core.errors import ConfigError
from perch_core.vehicle import GRAVITY, Vehicle
from perch_autopilot.rate_curve import CENTRE, HALF, RateCurve

LOW, HIGH = 1000, 2000  # pulse widths [us]
AXES = ("roll", "pitch", "yaw")


def rate_curves(settings: dict[str, str], source: str) -> tuple[RateCurve, ...]:
    """The curves of roll, pitch and yaw of a configuration.

    Raises:
        ConfigError: they are of another type, or missing.
    """
    if settings.get("rates_type") != "ACTUAL":
        raise ConfigError(source, "rates_type", f"{settings.get('rates_type')} is not ACTUAL, the one type that is known here")
    try:
        return tuple(RateCurve(10.0 * float(settings[f"{axis}_rc_rate"]), 10.0 * float(settings[f"{axis}_srate"]),
                               float(settings[f"{axis}_expo"]) / 100.0) for axis in AXES)
    except KeyError as error:
        raise ConfigError(source, error.args[0], "is not set: the sticks' meaning depends on it") from None


class Sticks:
    """Channels of body rates and thrust, in Betaflight's order AETR: roll, pitch, throttle, yaw, then switches.

    Attributes:
        curves: of roll, pitch, yaw.
        battery: how the thrust changes with the voltage.
    """

    def __init__(self, vehicle: Vehicle, curves: tuple[RateCurve, ...]) -> None:
        """
        Args:
            vehicle: its mass and thrust curve.
            curves: of roll, pitch, yaw.
        """
        self.curves, self._mass, self._coefficient = curves, vehicle.mass, vehicle.thrust_coefficient
        self._idle, self._span = vehicle.speed_min, vehicle.speed_max - vehicle.speed_min
        self.battery, self._share = vehicle.actuation.battery, 1.0

    def fits(self, voltage: float) -> bool:
        """Whether the thrust at a battery's voltage [V] is known."""
        low, high = self.battery.range
        return not self.battery.reference or low <= voltage <= high

    def measured(self, voltage: float) -> None:
        """Take the battery's voltage [V]; beyond the range of its curve the nearest end of that counts."""
        if self.battery.reference:
            low, high = self.battery.range
            self._share = (min(max(voltage, low), high) / self.battery.reference) ** self.battery.exponent

    def throttle(self, thrust: float) -> float:
        """Throttle 0..1 at which the four rotors together give a thrust per mass [m/s^2]: their speed is linear in it."""
        speed = sqrt(max(thrust, 0.0) * self._mass / (4.0 * self._coefficient * self._share))
        return min(max((speed - self._idle) / self._span, 0.0), 1.0)

    def throttle_for(self, share: float) -> int:
        """Throttle [us] that carries a share of the weight."""
        return self.channels((0.0, 0.0, 0.0), share * GRAVITY)[2]

    def channels(self, rates: Numbers, thrust: float) -> tuple[int, int, int, int]:
        """Pulse widths [us] of roll, pitch, throttle, yaw.

        Args:
            rates: angular velocity in FLU [rad/s]. Betaflight's sticks: roll to the right, nose *down*, nose to the right.
            thrust: of all rotors per mass [m/s^2].
        """
        p, q, r = (degrees(rate) for rate in rates)
        roll, pitch, yaw = (round(CENTRE + HALF * curve.stick(rate)) for curve, rate in zip(self.curves, (p, q, -r)))
        return roll, pitch, round(LOW + (HIGH - LOW) * self.throttle(thrust)), yaw
