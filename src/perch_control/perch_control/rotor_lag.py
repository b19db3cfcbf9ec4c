"""First-order lag of the rotor speeds: prediction, and the command that compensates for it.

`d Omega / dt = (Omega_cmd - Omega) / tau`, thrust = k Omega^2. With a command beyond the wanted speed, the rotor reaches this
speed after `lead` seconds instead of several `tau`. The thrusts that are reachable in that time are known in advance, so that
the allocation can choose among them.
"""

from __future__ import annotations

from math import exp
from typing import NamedTuple

from perch_core.jit import compiled
from perch_core.vehicle import Vehicle


@compiled
def lag_share(duration, time_constant):
    """Fraction of the way to its target that a first-order lag covers in a time [s]."""
    return 1.0 if time_constant <= 0.0 else 1.0 - exp(-duration / time_constant)


@compiled
def approached(speed, target, share):
    """Rotor speeds after the fraction `share` of the way to their targets [rad/s], 4 floats."""
    return (
        speed[0] + share * (target[0] - speed[0]), speed[1] + share * (target[1] - speed[1]),
        speed[2] + share * (target[2] - speed[2]), speed[3] + share * (target[3] - speed[3]),
    )


@compiled
def followed(speed, command, duration, time_constant):
    """Rotor speeds after a time [s] in which they have followed a constant command [rad/s], 4 floats."""
    return approached(speed, command, lag_share(duration, time_constant))


@compiled
def thrusts(speed, coefficient):
    """Rotor thrusts [N] from rotor speeds [rad/s], 4 floats each."""
    return (coefficient * speed[0] * speed[0], coefficient * speed[1] * speed[1],
            coefficient * speed[2] * speed[2], coefficient * speed[3] * speed[3])


@compiled
def reachable(speed, share, speed_min, speed_max):
    """Lowest and highest speeds that the rotors can have after the lead time [rad/s], 4 floats each.

    Both are clipped to the limits, also for a rotor that is outside them (off, or starting).
    """
    low = approached(speed, (speed_min, speed_min, speed_min, speed_min), share)
    high = approached(speed, (speed_max, speed_max, speed_max, speed_max), share)
    return ((max(low[0], speed_min), max(low[1], speed_min), max(low[2], speed_min), max(low[3], speed_min)),
            (min(max(high[0], speed_min), speed_max), min(max(high[1], speed_min), speed_max),
             min(max(high[2], speed_min), speed_max), min(max(high[3], speed_min), speed_max)))


@compiled
def leading_command(speed, thrust, coefficient, share, speed_min, speed_max):
    """Commands with which the rotors reach the wanted thrusts after the lead time, within their limits [rad/s], 4 floats."""
    a, b, c, d = thrust
    k = 1.0 / coefficient
    return (
        min(max(speed[0] + ((k * max(a, 0.0)) ** 0.5 - speed[0]) / share, speed_min), speed_max),
        min(max(speed[1] + ((k * max(b, 0.0)) ** 0.5 - speed[1]) / share, speed_min), speed_max),
        min(max(speed[2] + ((k * max(c, 0.0)) ** 0.5 - speed[2]) / share, speed_min), speed_max),
        min(max(speed[3] + ((k * max(d, 0.0)) ** 0.5 - speed[3]) / share, speed_min), speed_max),
    )


@compiled
def lag_behind(time_constant, lead, period):
    """Delay with which rotors follow steadily changing wanted speeds, with a new `leading_command` in every period [s].

    In each period the rotors cover the fraction a = (1 - exp(-period / tau)) / (1 - exp(-lead / tau)) of the way, so that they
    lag by period / a. This is less than `lead`, after which they would arrive if the command stayed constant.
    """
    return period * lag_share(lead, time_constant) / lag_share(period, time_constant)


class RotorEstimate(NamedTuple):
    """Estimate of the rotor speeds, from the lag model and the controller's own commands, or from measurements.

    Attributes:
        speed: present speeds [rad/s], 4 floats.
        command: speeds that the rotors are approaching [rad/s], 4 floats.
    """

    speed: tuple[float, ...]
    command: tuple[float, ...]

    @classmethod
    def at_idle(cls, vehicle: Vehicle) -> RotorEstimate:
        """Rotors at their lowest speed."""
        idle = (vehicle.speed_min,) * 4
        return cls(idle, idle)

    def after(self, duration: float, time_constant: float) -> RotorEstimate:
        """The same rotors `duration` seconds later, still following their command."""
        return RotorEstimate(followed(self.speed, self.command, duration, time_constant), self.command)

    def following(self, command: tuple[float, ...], *_: object) -> RotorEstimate:
        """The same rotors with a new command."""
        return RotorEstimate(self.speed, command)

    def turning(self, speed: float) -> RotorEstimate:
        """Return rotors that all turn at one speed [rad/s]."""
        return RotorEstimate((speed,) * 4, (speed,) * 4)

    def ahead(self, state: tuple[float, ...], vehicle: Vehicle) -> tuple[float, ...]:
        """Return the state at which a command sent at present takes effect: the present one, as there is no delay."""
        return state

    @property
    def at_effect(self) -> RotorEstimate:
        """Return the rotors at which a command sent at present takes effect: the present ones, as there is no delay."""
        return self

    @property
    def delay(self) -> float:
        """Time from a command to its effect [s]."""
        return 0.0

    @property
    def sent(self) -> None:
        """Command to an inner loop; None, since the rotors are commanded directly."""
        return None
