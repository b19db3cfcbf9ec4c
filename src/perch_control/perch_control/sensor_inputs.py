"""Sensor inputs of a flight: the state used for control, and the IMU samples since the last odometry."""

from __future__ import annotations

from collections import deque
from math import inf

import numpy as np

from perch_control.flight_state import FlightState
from perch_control.geometric import packed_vehicle
from perch_control.geometric.step import predicted
from perch_control.law import NO_COMPENSATION
from perch_control.odometry_gate import OdometryGate, Verdict
from perch_control.rotor_lag import thrusts
from perch_control.smooth_position import SmoothPosition

REFUSAL_LOG_PERIOD = 1.0
"""Shortest time between two logged refusals of samples [s]: with two publishers of odometry, every other sample is refused."""


class SensorInputs:
    """Owns the odometry gate.

    Attributes:
        age: age of the last accepted odometry sample [s].
        refusal: why the last sample was refused; empty: it was accepted.
        imu_since_odometry: IMU samples since the last accepted odometry: time [s], rates [rad/s], specific force [m/s^2].
    """

    def __init__(self) -> None:
        self.age, self.refusal, self._imu_stamp = inf, "", -inf
        self._next_refusal_log = -inf  # no refusal is logged until then [s]
        self.imu_since_odometry: deque[tuple[float, tuple[float, ...], tuple[float, ...]]] = deque(maxlen=500)
        self._gate, self._smooth = OdometryGate(), SmoothPosition()

    def imu_age(self, now: float) -> float:
        """Age of the last IMU sample at a time [s], in s; infinite before the first one."""
        return now - self._imu_stamp

    def imu(self, stamp: float, gyro: tuple[float, ...], accel: tuple[float, ...], keep: bool) -> None:
        """Take an IMU sample: time [s], in B [rad/s, m/s^2]; `keep` it for the beginning of a descent without position."""
        self._imu_stamp = stamp
        if keep:
            self.imu_since_odometry.append((stamp, gyro, accel))

    def odometry(self, x: FlightState, stamp: float, sample: tuple[float, ...], covariances: tuple[np.ndarray, np.ndarray] | None,
                 problem: str) -> tuple[FlightState, Verdict]:
        """Return the state from a sample, or predicted, and the verdict on it; arguments as in `FlightController.step`."""
        verdict = Verdict(False, reason=f"odometry: {problem}") if problem else self._gate.check(stamp, sample, covariances, x.flying)
        # Odometry that repeats itself does not stop the time.
        x = self._state_at(x, stamp if stamp > x.now else max(x.now, self._imu_stamp), verdict, sample)
        self.age = x.now - self._gate.stamp if self._gate.stamp is not None else inf
        return x, verdict

    def without_odometry(self, x: FlightState, now: float) -> FlightState:
        """Return the state at a time [s] for which there is no odometry."""
        dt, rotors = _elapsed_and_rotors(x, now)
        self.age += dt
        return x.sensed(now, x.state_estimate, x.last_odometry, rotors)

    def _state_at(self, x: FlightState, now: float, verdict: Verdict, sample: tuple[float, ...]) -> FlightState:
        """Return the state at a time [s], from a usable sample or predicted."""
        dt, rotors = _elapsed_and_rotors(x, now)
        if verdict.usable:
            self.refusal = ""
            self.imu_since_odometry.clear()
            return x.sensed(now, self._smooth.state(now, sample, x.order), (now, sample), rotors)
        if verdict.reason and not self.refusal and now >= self._next_refusal_log:
            self._next_refusal_log = now + REFUSAL_LOG_PERIOD
            x = x._replace(events=(*x.events, f"refused: {verdict.reason}"))
        self.refusal, state = verdict.reason, x.state_estimate
        if state and x.flying:
            body, _, forward, *_ = packed_vehicle(x.vehicle)
            f = thrusts(rotors.speed, x.vehicle.thrust_coefficient)
            state = predicted(state, f, NO_COMPENSATION, dt, body[0], body[1:4], forward)
        return x.sensed(now, state, x.last_odometry, rotors)


def _elapsed_and_rotors(x: FlightState, now: float) -> tuple:
    """Return the time elapsed until `now` [s], at most 0.1 s, and the rotors at its end."""
    dt = min(max(now - x.now, 0.0), 0.1)
    return dt, x.rotors.after(dt, x.vehicle.motor_time_constant)
