"""Controlled descent without position: level attitude, thrust slightly under the weight, motors off when the ground is felt.

The attitude comes from the gyroscope, corrected by the accelerometer while the vehicle flies steadily, or from odometry
whose attitude is still good.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt

from perch_core.vector3 import axes_of, cross, norm, scale, turned
from perch_core.vehicle import GRAVITY, Vehicle
from perch_control.flight_settings import FlightSettings
from perch_control.geometric.controller import packed_vehicle
from perch_control.geometric.law import moment
from perch_control.geometric.step import rotors_for
from perch_control.monitors import Persistent
from perch_control.settings import GeometricGains

_REST_TIME = 0.3    # 1 g for so long: on the ground [s]
_SETTLE_TIME = 0.3  # the change of thrust at the beginning is over [s]


@dataclass(frozen=True, slots=True)
class AttitudeByImu:
    """Attitude kept from gyroscope and accelerometer.

    Attributes:
        q: q_WB xyzw, 4 floats.
        w: body rates of the last sample [rad/s], 3 floats.
    """

    q: tuple[float, ...]
    w: tuple[float, ...] = (0.0, 0.0, 0.0)

    def after(self, gyro: tuple[float, ...], accel: tuple[float, ...], dt: float, gain: float = 0.3) -> AttitudeByImu:
        """The attitude after one IMU sample.

        Args:
            gyro: angular velocity in B [rad/s].
            accel: specific force in B [m/s^2]; its direction counts as vertical while its length is near 1 g.
            dt: time since the last sample [s].
            gain: rate of the correction [1/s].
        """
        n = sqrt(accel[0] ** 2 + accel[1] ** 2 + accel[2] ** 2)
        correction = (0.0, 0.0, 0.0)
        if 0.8 * GRAVITY < n < 1.2 * GRAVITY:
            b1, b2, b3 = axes_of(self.q)
            correction = cross((accel[0] / n, accel[1] / n, accel[2] / n), (b1[2], b2[2], b3[2]))
        phi = tuple(dt * (gyro[i] + gain * correction[i]) for i in range(3))
        return AttitudeByImu(turned(self.q, phi), tuple(gyro))


class BlindDescent:
    """The descent itself; owns the attitude and decides when the ground is felt."""

    def __init__(self, vehicle: Vehicle, gains: GeometricGains, settings: FlightSettings, q: tuple[float, ...],
                 w: tuple[float, ...], now: float) -> None:
        """`q`, `w`: last attitude (xyzw) and body rates [rad/s] that could be trusted; `now`: time of the beginning [s]."""
        self._gains, self._settings, self._constants = gains, settings, packed_vehicle(vehicle)
        self._mass = vehicle.mass
        self.attitude = AttitudeByImu(tuple(q), tuple(w))
        self._stamp, self._start = now, now
        self._rest, self._force = Persistent(_REST_TIME), GRAVITY
        self.landed = False

    def imu(self, stamp: float, gyro: tuple[float, ...], accel: tuple[float, ...]) -> None:
        """Take one IMU sample: time [s], angular velocity [rad/s] and specific force [m/s^2] in B."""
        self.attitude = self.attitude.after(gyro, accel, min(max(stamp - self._stamp, 0.0), 0.02))
        self._stamp = stamp
        force = norm(accel)
        # On the ground the accelerometer reads 1 g; in this descent it reads `descent_share` of it.
        middle = 0.5 * (1.0 + self._settings.descent_share) * GRAVITY
        self._force += 0.02 * (force - self._force)  # 0.1 s mean: rotor vibration is ten times the difference
        resting = self._rest.update(middle < self._force < 1.1 * GRAVITY and norm(gyro) < 0.5, stamp)
        begun = stamp - self._start > _SETTLE_TIME
        self.landed = self.landed or (begun and (resting or force > self._settings.impact_acceleration))

    def wanted(self) -> tuple[float, float, float, float]:
        """Collective thrust [N] and moments in B [N m]: level, no rotation, a little less than the weight."""
        q, w = self.attitude.q, self.attitude.w
        b1, b2, b3 = axes_of(q)
        up_B = (b1[2], b2[2], b3[2])
        # e_R of the shortest turn to level, 2 sin(angle / 2) about b3 x e3 in B; it leaves the heading free.
        lean = norm((up_B[0], up_B[1], 0.0))
        half = sqrt(max(0.5 * (1.0 - up_B[2]), 0.0))
        e_R = scale(2.0 * half / lean, (up_B[1], -up_B[0], 0.0)) if lean > 1e-9 else (2.0 * half, 0.0, 0.0)
        g = self._gains
        M = moment(w, e_R, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), self._constants[0][1:4], g.attitude, g.rate, (0.0, 0.0, 0.0))
        share = self._settings.descent_share
        thrust = self._mass * GRAVITY * share / max(b3[2], 0.5) if b3[2] > 0.0 else 0.2 * self._mass * GRAVITY
        return (thrust, *M)

    def rotors(self, speed: tuple[float, ...]) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Rotor commands [rad/s] and the thrusts that they reach [N], from the present rotor speeds."""
        return rotors_for(self.wanted(), speed, self._constants, self._gains.lead)
