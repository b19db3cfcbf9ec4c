"""Airborne part of a flight as arrays: commands, gyroscope, accelerometer and velocity."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from perch_core.errors import PerchError
from perch_core.vehicle import GRAVITY
from perch_eval.flight import Flight, interpolated

MIN_DURATION = 5.0    # of a record in the air [s]
AIRBORNE_SHARE = 0.6  # specific force along b3 in flight, as a share of gravity
SKIPPED_START = 1.5   # from take-off until the ground has no further effect [s]


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
