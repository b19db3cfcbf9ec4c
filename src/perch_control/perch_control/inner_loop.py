"""Inner loop in front of the rotors: the vehicle takes collective thrust with body rates or an attitude, and follows with a lag.

    w' = (rate_gain w_cmd - w) / rate_lag        T' = (thrust_gain T_cmd - T) / thrust_lag        on commands that are `delay` old

The control laws command rotor speeds in this case, too. From these, the rotor model with its lag and limits predicts the moment M
and thrust T one period later. The inverse of the loop's model turns them into a loop command that is feasible for the rotors:

    w_cmd = (w + rate_lag J^-1 (M - w x J w)) / rate_gain
    T_cmd = (T_now + (T - T_now) / (1 - exp(-period / thrust_lag))) / thrust_gain
    q_cmd = q exp(attitude_lag (w_cmd - w_C)), for an attitude loop that commands the rates w_C + error / attitude_lag

All quantities are those at the time at which the command takes effect. `InnerLoopEstimate` takes the place of `RotorEstimate`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from perch_control.geometric.controller import packed_vehicle
from perch_control.geometric.step import predicted, wrench_of
from perch_control.period import NOMINAL_PERIOD
from perch_control.rotor_lag import RotorEstimate, followed, lag_share, thrusts
from perch_core.jit import compiled
from perch_core.vector3 import axpy, cross, limited, scale, times, turned
from perch_core.vehicle import Vehicle

if TYPE_CHECKING:
    from perch_control.reference import Following, Setpoint, Source

_TURN_MAX = 1.5         # of a commanded attitude from the present one [rad]
_ZERO = (0.0, 0.0, 0.0)
_REST = (0.0,) * 4
_TIME_TOLERANCE = 1e-6  # [s]


class LoopCommand(NamedTuple):
    """Command to an inner loop.

    Attributes:
        w_B: body rates [rad/s], 3 floats: the command to a rate loop, or the feed-forward of an attitude loop.
        thrust: collective thrust / mass [m/s^2].
        q_WB: attitude xyzw, 4 floats.
    """

    w_B: tuple[float, ...] = _ZERO
    thrust: float = 0.0
    q_WB: tuple[float, ...] = (0.0, 0.0, 0.0, 1.0)


class DelayedReference(NamedTuple):
    """A running reference at the time at which a command sent at present takes effect; see `Following`.

    Attributes:
        running: the reference.
        delay: time from a command to its effect [s].
    """

    running: Following
    delay: float

    @property
    def source(self) -> Source:
        """Source of the reference."""
        return self.running.source

    @property
    def elapsed(self) -> float:
        """Time since the start of the reference, at the end of the delay [s]."""
        return self.running.elapsed + self.delay

    def setpoint(self, ahead: float = 0.0) -> Setpoint:
        """Setpoint `ahead` seconds after the delay."""
        return self.running.setpoint(ahead + self.delay)


@compiled
def loop_command(f, w, T_now, lags, share, vehicle):
    """Rates and thrust, before the loop's gains, that yield the moment and sum of rotor thrusts, by the loop's inverse model.

    Args:
        f: rotor thrusts [N], 4 floats.
        w: body rates [rad/s], 3 floats.
        T_now: collective thrust at the beginning of the period [N].
        lags: lags of the rates [s], 3 floats.
        share: fraction of the way to its command that the thrust covers in a period.
        vehicle: constants (see `packed_vehicle`).

    Returns:
        Rates [rad/s], 3 floats, and thrust [N].
    """
    J = vehicle[0][1:4]
    T, Mx, My, Mz = wrench_of(f, vehicle[2])
    gyro = cross(w, times(J, w))
    return (w[0] + lags[0] * (Mx - gyro[0]) / J[0], w[1] + lags[1] * (My - gyro[1]) / J[1], w[2] + lags[2] * (Mz - gyro[2]) / J[2],
            T_now + (T - T_now) / share)


class InnerLoopEstimate(NamedTuple):
    """Estimate of the rotors behind an inner loop, with the interface of `RotorEstimate`.

    Attributes:
        nominal: the vehicle of the vehicle file.
        at_effect: rotors at the time at which a command sent at present takes effect, by their lag model and the laws' commands.
        speed: present rotor speeds [rad/s], 4 floats.
        pending_speeds: (time until then [s], rotor speeds) for the times between the present and that of `at_effect`.
        thrust: collective thrust of the loop at that time, by the loop's model and the file's thrust coefficient [N].
        period: period of the commands [s].
        sent: the last command.
    """

    nominal: Vehicle
    at_effect: RotorEstimate
    speed: tuple[float, ...] = _REST
    pending_speeds: tuple[tuple[float, tuple[float, ...]], ...] = ()
    thrust: float = 0.0
    period: float = NOMINAL_PERIOD
    sent: LoopCommand = LoopCommand()

    @property
    def delay(self) -> float:
        """Time from a command to its effect [s]."""
        return self.nominal.actuation.delay

    def turning(self, speed: float) -> InnerLoopEstimate:
        """Return the estimate with all rotors at one speed [rad/s]."""
        thrust = 4.0 * self.nominal.thrust_coefficient * speed * speed
        return InnerLoopEstimate(self.nominal, self.at_effect.turning(speed), (speed,) * 4, (), thrust, self.period)

    def after(self, duration: float, time_constant: float) -> InnerLoopEstimate:
        """Return the estimate `duration` seconds later."""
        pending_speeds = tuple((left - duration, speed) for left, speed in self.pending_speeds)
        reached = sum(left < _TIME_TOLERANCE for left, _ in pending_speeds)
        return self._replace(at_effect=self.at_effect.after(duration, time_constant),
                             speed=pending_speeds[reached - 1][1] if reached else self.speed,
                             pending_speeds=pending_speeds[reached:], period=duration if duration > 0.0 else self.period)

    def ahead(self, state: tuple[float, ...], vehicle: Vehicle) -> tuple[float, ...]:
        """Predict the state at which a command sent at present takes effect.

        Args:
            state: present state, 13 floats (see `Law.control`).
            vehicle: the vehicle model in use.
        """
        if self.delay <= 0.0:
            return state
        speeds = [self.speed, *(speed for _, speed in self.pending_speeds)]
        f = thrusts(tuple(sum(column) / len(speeds) for column in zip(*speeds)), vehicle.thrust_coefficient)
        constants = packed_vehicle(vehicle)
        return predicted(state, f, (0.0,) * 6, self.delay, constants[0][0], constants[0][1:4], constants[2])

    def following(self, command: tuple[float, ...], state: tuple[float, ...], vehicle: Vehicle,
                  w_C: tuple[float, ...] = _ZERO) -> InnerLoopEstimate:
        """Return the estimate with the loop command that makes the rotors follow commanded speeds.

        Args:
            command: rotor speeds [rad/s], 4 floats.
            state: state at which the command takes effect, 13 floats.
            vehicle: the vehicle model in use.
            w_C: feed-forward rates of an attitude loop [rad/s].
        """
        a, tau, nominal = vehicle.actuation, vehicle.motor_time_constant, self.nominal
        reached = followed(self.at_effect.speed, command, self.period, tau)
        share = lag_share(self.period, a.thrust_lag)
        thrust_ratio = vehicle.thrust_coefficient / nominal.thrust_coefficient
        *rates, thrust = loop_command(thrusts(reached, vehicle.thrust_coefficient), state[10:13], thrust_ratio * self.thrust,
                                      a.rate_lag, share, packed_vehicle(vehicle))
        thrust = min(max(thrust / thrust_ratio, 0.0), 4.0 * nominal.thrust_max)
        rates_command = tuple(min(max(rate / gain, -a.rate_max), a.rate_max) for rate, gain in zip(rates, a.rate_gain))
        turn = limited(scale(a.attitude_lag, axpy(-1.0, w_C, rates_command)), _TURN_MAX)
        sent = LoopCommand(rates_command if a.type == "rates_and_thrust" else w_C, thrust / nominal.mass / a.thrust_gain,
                           turned(state[6:10], turn))
        return self._replace(at_effect=self.at_effect.following(command),
                             pending_speeds=(*self.pending_speeds, (self.delay, self.at_effect.speed)),
                             thrust=self.thrust + share * (thrust - self.thrust), sent=sent)


def rotors_at_rest(vehicle: Vehicle) -> RotorEstimate | InnerLoopEstimate:
    """Return the estimate of rotors at rest, behind an inner loop where the vehicle has one."""
    rotors = RotorEstimate(_REST, _REST)
    return rotors if vehicle.actuation.type == "rotor_speeds" else InnerLoopEstimate(vehicle, rotors)
