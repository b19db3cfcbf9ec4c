"""Body rates and thrust to stick positions, by the inverses of the firmware's rate curve and the vehicle's thrust curve."""

from __future__ import annotations

from math import degrees, sqrt

from perch_core.arrays import Numbers
from perch_core.errors import ConfigError
from perch_core.vehicle import GRAVITY, Vehicle, load_vehicle
from perch_autopilot.rate_curve import CENTRE, HALF, RateCurve

LOW, HIGH = 1000, 2000  # pulse widths [us]
RATE_MAX = 1998.0       # rate that the firmware can command [deg/s]
AXES = ("roll", "pitch", "yaw")


def rate_curves(settings: dict[str, str], source: str) -> tuple[RateCurve, ...]:
    """Return the rate curves of roll, pitch and yaw of a configuration.

    Raises:
        ConfigError: the curves are of another type, a setting is missing, or a value is outside the firmware's range.
    """
    if settings.get("rates_type") != "ACTUAL":
        raise ConfigError(source, "rates_type", f"{settings.get('rates_type')} is not ACTUAL, the only supported type")

    def value(key: str, low: float, high: float) -> float:
        try:
            number = float(settings[key])
        except KeyError:
            raise ConfigError(source, key, "is not set: stick positions depend on it") from None
        except ValueError:
            raise ConfigError(source, key, f"{settings[key]} is not a number") from None
        if not low <= number <= high:
            raise ConfigError(source, key, f"{number:g} is outside [{low:g}, {high:g}]")
        return number

    curves = []
    for axis in AXES:
        centre = value(f"{axis}_rc_rate", 1.0, RATE_MAX / 10.0)
        maximum = value(f"{axis}_srate", centre, RATE_MAX / 10.0)
        curves.append(RateCurve(10.0 * centre, 10.0 * maximum, value(f"{axis}_expo", 0.0, 100.0) / 100.0))
    return tuple(curves)


def commanded_vehicle(name: str) -> Vehicle:
    """Return the vehicle of `config/vehicles/<name>.yaml`, or of a file, which an autopilot flies by body rates and thrust.

    Raises:
        ConfigError: no such vehicle, or one that takes other commands.
    """
    vehicle = load_vehicle(name)
    if vehicle.actuation.type != "rates_and_thrust":
        raise ConfigError(name, "actuation.type", f"{vehicle.actuation.type}: an autopilot takes rates_and_thrust")
    return vehicle


class Sticks:
    """Conversion of body rates and thrust to channels, in Betaflight's order: roll, pitch, throttle, yaw.

    Attributes:
        curves: rate curves of roll, pitch, yaw.
        battery: dependence of the thrust on the voltage.
    """

    def __init__(self, vehicle: Vehicle, curves: tuple[RateCurve, ...]) -> None:
        """
        Args:
            vehicle: provides mass and thrust curve.
            curves: rate curves of roll, pitch, yaw.
        """
        self.curves, self._mass, self._coefficient = curves, vehicle.mass, vehicle.thrust_coefficient
        self._idle, self._span = vehicle.speed_min, vehicle.speed_max - vehicle.speed_min
        self.battery, self._voltage_factor = vehicle.actuation.battery, 1.0

    def covers_voltage(self, voltage: float) -> bool:
        """Return whether the thrust curve covers a battery voltage [V]."""
        low, high = self.battery.range
        return not self.battery.reference or low <= voltage <= high

    def set_voltage(self, voltage: float) -> None:
        """Set the battery's voltage [V], clamped to the range of the thrust curve. 0 is no measurement: the last voltage stays."""
        if self.battery.reference and voltage > 0.0:
            low, high = self.battery.range
            self._voltage_factor = (min(max(voltage, low), high) / self.battery.reference) ** self.battery.exponent

    def throttle(self, thrust: float) -> float:
        """Return the throttle 0..1 for a collective thrust per mass [m/s^2]; the rotor speed is linear in the throttle."""
        speed = sqrt(max(thrust, 0.0) * self._mass / (4.0 * self._coefficient * self._voltage_factor))
        return min(max((speed - self._idle) / self._span, 0.0), 1.0)

    def throttle_for(self, share: float) -> int:
        """Return the throttle [us] that carries a share of the weight."""
        return self.channels((0.0, 0.0, 0.0), share * GRAVITY)[2]

    def channels(self, rates: Numbers, thrust: float) -> tuple[int, int, int, int]:
        """Return the pulse widths [us] of roll, pitch, throttle, yaw.

        Args:
            rates: angular velocity in FLU [rad/s]. Betaflight's sticks: roll to the right, nose *down*, nose to the right.
            thrust: collective thrust per mass [m/s^2].
        """
        p, q, r = (degrees(rate) for rate in rates)
        roll, pitch, yaw = (round(CENTRE + HALF * curve.stick(rate)) for curve, rate in zip(self.curves, (p, q, -r)))
        return roll, pitch, round(LOW + (HIGH - LOW) * self.throttle(thrust)), yaw
