"""Flight for identification (a hover, then short moves along each axis and turns, at rest in between), and the airborne part of a
flight as arrays: commands, gyroscope, accelerometer and velocity."""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass, fields, replace

import numpy as np

from perch_control.modes import State
from perch_core.errors import PerchError
from perch_core.trajectory import rest_to_rest
from perch_core.vehicle import GRAVITY
from perch_eval.flight import Flight, interpolated
from perch_eval.scripted_flight import LEAD, ScriptedFlight
from perch_sim.scenario import Scenario

HEIGHT = 1.5                                       # of the hover [m]
MOVES = (((0.8, 0.0, 0.0), 0.0, 0.9), ((0.0, 0.8, 0.0), 0.0, 0.9), ((0.0, 0.0, 0.6), 0.0, 0.8), ((0.0, 0.0, 0.0), 1.2, 0.8),
         ((1.5, 0.0, 0.4), -0.8, 1.3), ((0.0, -1.2, -0.3), 0.8, 1.1))
"""(Offset [m], turn [rad], duration [s]) of each move, which is flown there and back."""
ROUNDS = 2                                         # all of them
PAUSE = 0.3                                        # between them [s]
MIN_DURATION = 5.0    # of a record in the air [s]
AIRBORNE_SHARE = 0.6  # specific force along b3 in flight, as a share of gravity
SKIPPED_START = 1.5   # from take-off until the ground has no further effect [s]


def fly(scenario: Scenario, vehicle: str, seed: int, stretch: float = 1.0) -> Flight:
    """Fly in the simulator with estimated state and without L1, as its corrections depend on the response to be identified.

    Args:
        scenario: the world, and the differences of the true vehicle from its file.
        vehicle: name or file of the vehicle that the controller assumes.
        seed: seed of all random draws.
        stretch: factor of the moves' durations, above 1 if less thrust is available.

    Raises:
        PerchError: the controller leaves its hover: the vehicle does not fly with this file.
    """
    flight = ScriptedFlight(replace(scenario, vehicle=vehicle), seed, without=("powerline_mapper", "perching_planner", "powerline_planner"))
    mission, controller = flight.mission, flight.controller.flight
    controller.compensator = None
    with closing(flight.loop):
        flight.run(flight.arm() + 0.1)
        place, yaw = mission.p_WB, 0.0
        for offset, turn, duration in (((0.0, 0.0, HEIGHT), 0.0, 2.5), *(
                (sign * np.array(offset), sign * turn, stretch * T) for offset, turn, T in ROUNDS * MOVES for sign in (1.0, -1.0))):
            mission.follow(rest_to_rest(place, place + offset, yaw, yaw + turn, duration, mission.time + LEAD))
            place, yaw = place + offset, yaw + turn
            flight.run(flight.time + duration + LEAD + PAUSE)
            if controller.state is not State.HOVERING:
                raise PerchError(f"the vehicle does not fly by its file: {controller.flight_state.message}; correct its mass or its lags")
    return flight.loop.trace.flight


@dataclass(frozen=True)
class Record:
    """Airborne part of a flight, without take-off and landing.

    Attributes:
        t: stamps of the IMU's samples [s], (n,); `period` apart.
        gyro, accel: samples of the IMU [rad/s], [m/s^2], (n, 3).
        v_B: velocity in B at the IMU's samples [m/s], (n, 3).
        command_t: stamps of the commands [s], (m,).
        rates: commanded body rates [rad/s], (m, 3); None: rotor speeds or attitudes are commanded.
        thrust: commanded thrust per mass [m/s^2], (m,); None: rotor speeds are commanded.
        rotor_speeds: commanded rotor speeds [rad/s], (m, 4); None: thrust with rates or attitudes is commanded.
    """

    t: np.ndarray
    gyro: np.ndarray
    accel: np.ndarray
    v_B: np.ndarray
    command_t: np.ndarray
    rates: np.ndarray | None = None
    thrust: np.ndarray | None = None
    rotor_speeds: np.ndarray | None = None

    @property
    def period(self) -> float:
        """Period of the IMU [s]."""
        return float(np.median(np.diff(self.t)))

    def commands_at(self, values: np.ndarray, delay: float) -> np.ndarray:
        """Return commands (m, ...), interpolated at `delay` before each IMU sample, (n, ...).

        Interpolation of a command that is held for a period h is early by h / 2, and an IMU that averages over its period is late
        by the same: `delay` is the vehicle's delay plus one period.
        """
        if values.ndim == 1:
            return np.interp(self.t - delay, self.command_t, values)
        return interpolated(self.t - delay, self.command_t, values)


def record_of(flight: Flight) -> Record:
    """Return the record of a flight.

    Raises:
        PerchError: IMU, odometry or commands are missing or not finite, or the time in the air is too short.
    """
    commands = {channel: [(t, c) for t, c in flight.values(channel) if c.armed]
                for channel in ("rates_thrust_command", "attitude_thrust_command", "motor_command")}
    channel = max(commands, key=lambda name: len(commands[name]))
    states, sent = flight.states("odometry"), commands[channel]
    t, f = flight.vectors("imu/data_raw", lambda sample: sample.f_B)
    _, w = flight.vectors("imu/data_raw", lambda sample: sample.w_B)
    counts = {"imu/data_raw": len(t), "odometry": 0 if states is None else len(states.t), "commands to the vehicle while armed": len(sent)}
    for name, n in counts.items():
        if n < 100:
            raise PerchError(f"the flight has no {name}")
    assert states is not None
    command_t = np.array([time for time, _ in sent])
    window = max(1, round(0.1 / float(np.median(np.diff(t)))))
    airborne = np.convolve(f[:, 2], np.ones(window) / window, "same") > AIRBORNE_SHARE * GRAVITY
    moving = airborne & (t > command_t[0]) & (t < command_t[-1])
    height = np.interp(t, states.t, states.p[:, 2])
    moving &= height > height[0] + 0.3
    if not moving.any() or t[moving][-1] - t[moving][0] < MIN_DURATION + SKIPPED_START:
        raise PerchError(f"less than {MIN_DURATION:g} s of the flight are in the air")
    keep = (t > t[moving][0] + SKIPPED_START) & (t < t[moving][-1] - 0.2)
    velocity = np.array([value.v_B for _, value in sorted(flight.values("odometry"), key=lambda pair: pair[0])])
    v_B = interpolated(t[keep], states.t, velocity)
    rotors = channel == "motor_command"
    record = Record(
        t[keep], w[keep], f[keep], v_B, command_t,
        rates=np.array([c.w_B for _, c in sent]) if channel == "rates_thrust_command" else None,
        thrust=None if rotors else np.array([c.thrust for _, c in sent]),
        rotor_speeds=np.array([c.rotor_speed for _, c in sent]) if rotors else None)
    for one in fields(record):
        values = getattr(record, one.name)
        if values is not None and not np.isfinite(values).all():
            raise PerchError(f"the flight's {one.name} is not finite in {np.count_nonzero(~np.isfinite(values))} of {values.size} values")
    return record
