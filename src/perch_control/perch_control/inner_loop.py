"""An inner loop in the place of the rotors: the vehicle takes body rates, or an attitude, with collective thrust, and follows with a lag.

    w' = (gain w_cmd - w) / rate_lag        T' = (gain T_cmd - T) / thrust_lag        on commands that are `delay` old

The control laws ask for rotor thrusts as always, for `delay` from now, and fly a vehicle whose rotors have no lag of their own (`flown`):
that lag is the loop's. `InnerLoopEstimate` takes the place of `RotorEstimate`: it gives the laws the rotor speeds of the moment and thrust that
the loop has by this model, and turns the thrusts that they answer into the command with which the loop has the same:

    w_cmd = w + rate_lag w'_wanted          T_cmd = T + (T_wanted - T) / (1 - exp(-lead / thrust_lag))
    q_cmd = q exp(attitude_lag (w_cmd - w_C)), for an attitude loop that asks for the rates w_C + error / attitude_lag
"""

from __future__ import annotations

from dataclasses import replace
from math import exp
from typing import TYPE_CHECKING, NamedTuple

from perch_control.geometric.controller import packed_vehicle
from perch_control.geometric.step import wrench_of
from perch_control.rotor_lag import RotorEstimate, thrusts
from perch_core.jit import compiled
from perch_core.vector3 import axpy, cross, limited, scale, times, turned
from perch_core.vehicle import Vehicle

if TYPE_CHECKING:
    from perch_control.parameters import ControllerParameters

_LEAD = 0.01     # the thrust is led by so much beyond the delay [s]
_SHORTEST = 0.002  # a command acts for a control period [s]
_LARGEST_TURN = 1.5  # of a commanded attitude from the present one [rad]
_ZERO = (0.0, 0.0, 0.0)


class LoopCommand(NamedTuple):
    """What is sent to an inner loop.

    Attributes:
        w_B: body rates [rad/s], 3 floats: to follow, or to feed forward where an attitude is taken.
        thrust: collective thrust / mass [m/s^2].
        q_WB: attitude xyzw, 4 floats.
    """

    w_B: tuple[float, ...] = _ZERO
    thrust: float = 0.0
    q_WB: tuple[float, ...] = (0.0, 0.0, 0.0, 1.0)


@compiled
def loop_speeds(w, acceleration, thrust, vehicle):
    """Rotor speeds of an angular acceleration [rad/s^2] and a collective thrust [N] at rates `w`, within the rotors' limits [rad/s], 4 floats."""
    J, (coefficient, low, high, _), (a, x, y, d) = vehicle[0][1:4], vehicle[1], vehicle[3]
    M = axpy(1.0, times(J, acceleration), cross(w, times(J, w)))
    k, least, most = 1.0 / coefficient, low * low, high * high
    return (min(max(k * (a[0] * thrust + x[0] * M[0] + y[0] * M[1] + d[0] * M[2]), least), most) ** 0.5,
            min(max(k * (a[1] * thrust + x[1] * M[0] + y[1] * M[1] + d[1] * M[2]), least), most) ** 0.5,
            min(max(k * (a[2] * thrust + x[2] * M[0] + y[2] * M[1] + d[2] * M[2]), least), most) ** 0.5,
            min(max(k * (a[3] * thrust + x[3] * M[0] + y[3] * M[1] + d[3] * M[2]), least), most) ** 0.5)


@compiled
def loop_acceleration(w, speed, vehicle):
    """Angular acceleration [rad/s^2] and collective thrust [N] of rotor speeds: what `loop_speeds` takes."""
    J = vehicle[0][1:4]
    T, Mx, My, Mz = wrench_of(thrusts(speed, vehicle[1][0]), vehicle[2])
    gyro = cross(w, times(J, w))
    return ((Mx - gyro[0]) / J[0], (My - gyro[1]) / J[1], (Mz - gyro[2]) / J[2]), T


@compiled
def loop_now(w, acting, coming, thrust, delay, lags, vehicle):
    """What the loop does by its model: rotor speeds now and in the middle of the delay, rates and thrust at its end.

    Args:
        w: body rates [rad/s], 3 floats.
        acting: rates and thrust that it follows now [rad/s, N], 4 floats.
        coming: the mean of those that it follows until `delay` from now, 4 floats.
        thrust: collective, now [N].
        delay: [s].
        lags: of the rates and of the thrust [s], 4 floats.
        vehicle: constants (see `packed_vehicle`).
    """
    now = ((acting[0] - w[0]) / lags[0], (acting[1] - w[1]) / lags[1], (acting[2] - w[2]) / lags[2])
    mean = ((coming[0] - w[0]) * (1.0 - exp(-delay / lags[0])) / delay, (coming[1] - w[1]) * (1.0 - exp(-delay / lags[1])) / delay,
            (coming[2] - w[2]) * (1.0 - exp(-delay / lags[2])) / delay)
    middle = coming[3] + (thrust - coming[3]) * exp(-0.5 * delay / lags[3])
    speed, later = loop_speeds(w, now, thrust, vehicle), loop_speeds(w, mean, middle, vehicle)
    acceleration, _ = loop_acceleration(w, later, vehicle)
    return speed, later, axpy(delay, acceleration, w), coming[3] + (thrust - coming[3]) * exp(-delay / lags[3])


class InnerLoop:
    """An inner loop's constants.

    Attributes:
        vehicle: as believed; its rotors have no lag.
        packed: the same as the kernels take it.
        share: of the file's thrust that it is believed to have.
        delay, lags, lead: [s], of the rates and the thrust [s], share of the way to its command that the thrust goes in `_LEAD`.
    """

    def __init__(self, vehicle: Vehicle, nominal: float) -> None:
        """`nominal`: thrust coefficient of the file [N s^2/rad^2]."""
        a = vehicle.actuation
        self.vehicle, self.packed, self.nominal = vehicle, packed_vehicle(vehicle), nominal
        self.share = vehicle.thrust_coefficient / nominal
        self.delay, self.lags, self.lead = max(a.delay, _SHORTEST), (*a.rate_lag, a.thrust_lag), 1.0 - exp(-_LEAD / a.thrust_lag)


class InnerLoopEstimate(NamedTuple):
    """An inner loop as the controller believes it to be: its model run on the controller's own commands. Used as `RotorEstimate` is.

    Attributes:
        loop: its constants.
        speed: of rotors that give its moment and thrust now [rad/s], 4 floats.
        command: the same in the middle of the delay, 4 floats.
        thrust: collective, by the file's thrust coefficient [N].
        acting: rates and thrust that it follows [rad/s, N], 4 floats.
        coming: (time until it follows them [s], rates and thrust) of the commands that are on their way, in order.
        ahead: q_WB, w_WB_B [rad/s] and thrust [N] at the end of the delay, 4 + 3 + 1 floats.
        sent: the last command.
    """

    loop: InnerLoop
    speed: tuple[float, ...]
    command: tuple[float, ...]
    thrust: float
    acting: tuple[float, ...]
    coming: tuple[tuple[float, tuple[float, ...]], ...] = ()
    ahead: tuple[float, ...] = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0)
    sent: LoopCommand = LoopCommand()

    def turning(self, speed: float) -> InnerLoopEstimate:
        """Without rotation, with the thrust of rotors of one speed [rad/s]."""
        thrust = 4.0 * self.loop.nominal * speed * speed
        return InnerLoopEstimate(self.loop, (speed,) * 4, (speed,) * 4, thrust, (0.0, 0.0, 0.0, thrust))

    def after(self, duration: float, time_constant: float) -> InnerLoopEstimate:
        """The same loop `duration` seconds later; its rotors' own time constant is none of the model."""
        coming = [(left - duration, command) for left, command in self.coming]
        begun = [command for left, command in coming if left < 1e-6]
        thrust = self.acting[3] + (self.thrust - self.acting[3]) * exp(-duration / self.loop.lags[3])
        return self._replace(thrust=thrust, acting=begun[-1] if begun else self.acting, coming=tuple(coming[len(begun):]))

    def at(self, state: tuple[float, ...], vehicle: Vehicle) -> InnerLoopEstimate:
        """The same loop on a vehicle in a state of 13 floats (see `Law.control`); before each step of a law."""
        loop = self.loop if vehicle is self.loop.vehicle else InnerLoop(vehicle, self.loop.nominal)
        commands = [self.acting, *(command for _, command in self.coming)]
        mean = tuple(sum(column) / len(commands) for column in zip(*commands))
        k, w = loop.share, state[10:13]
        speed, middle, w_ahead, thrust = loop_now(w, (*self.acting[:3], k * self.acting[3]), (*mean[:3], k * mean[3]), k * self.thrust, loop.delay,
                                                  loop.lags, loop.packed)
        q = turned(state[6:10], scale(0.5 * loop.delay, axpy(1.0, w, w_ahead)))
        return self._replace(loop=loop, speed=speed, command=middle, ahead=(*q, *w_ahead, thrust))

    def following(self, speed: tuple[float, ...], w_C: tuple[float, ...] = _ZERO) -> InnerLoopEstimate:
        """The same loop with the command that gives the moment and the thrust of rotor speeds at the end of the delay.

        Args:
            speed: [rad/s], 4 floats.
            w_C: rates that an attitude loop is to feed forward [rad/s].
        """
        loop, a = self.loop, self.loop.vehicle.actuation
        q, w, thrust = self.ahead[0:4], self.ahead[4:7], self.ahead[7]
        acceleration, wanted = loop_acceleration(w, speed, loop.packed)
        rates = tuple(min(max(w[i] + loop.lags[i] * acceleration[i], -a.rate_max * a.rate_gain[i]), a.rate_max * a.rate_gain[i]) for i in range(3))
        force = min(max(thrust + (wanted - thrust) / loop.lead, 0.0), 4.0 * loop.vehicle.thrust_max) / loop.share
        asked = (rates[0] / a.rate_gain[0], rates[1] / a.rate_gain[1], rates[2] / a.rate_gain[2])
        turn = limited(scale(a.attitude_lag, axpy(-1.0, w_C, asked)), _LARGEST_TURN)
        sent = LoopCommand(asked if a.type == "rates_and_thrust" else w_C, force / loop.vehicle.mass / a.thrust_gain, turned(q, turn))
        return self._replace(coming=(*self.coming, (a.delay, (*rates, force))), sent=sent)


def flown(vehicle: Vehicle) -> Vehicle:
    """The vehicle as the laws fly it: behind an inner loop the rotors have no lag of their own."""
    return vehicle if vehicle.actuation.type == "rotor_speeds" else replace(vehicle, motor_time_constant=0.0)


def led(params: ControllerParameters, vehicle: Vehicle) -> ControllerParameters:
    """The parameters with which it is flown: an inner loop gives what is asked for after its delay, whatever lead the rotors would need."""
    if vehicle.actuation.type == "rotor_speeds":
        return params
    lead = max(vehicle.actuation.delay, _SHORTEST)
    return replace(params, **{name: replace(getattr(params, name), lead=lead) for name in ("snapdragon", "rpg", "nmpc")})


def stopped(vehicle: Vehicle) -> RotorEstimate | InnerLoopEstimate:
    """What is believed of rotors, or of the loop in front of them, that stand still."""
    still = RotorEstimate((0.0,) * 4, (0.0,) * 4)
    if vehicle.actuation.type == "rotor_speeds":
        return still
    return InnerLoopEstimate(InnerLoop(vehicle, vehicle.thrust_coefficient), *still, 0.0, (0.0,) * 4)
