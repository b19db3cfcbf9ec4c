"""Controlled descent without position: speed braked, thrust slightly below the weight, motors off on ground contact.

The attitude is integrated from the gyroscope, and corrected by the accelerometer while the specific force is near 1 g. The
velocity is integrated from the last odometry with the accelerometer and a leak: it represents mainly the speed at the loss of
odometry, which is braked, since a wall may be near.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt

from perch_core.vector3 import axes_of, axpy, cross, dot, limited, norm, scale, turned
from perch_core.vehicle import GRAVITY, ControlGains, Vehicle
from perch_control.geometric.controller import packed_vehicle
from perch_control.geometric.law import moment
from perch_control.geometric.step import rotors_for
from perch_control.debounce import Debounce

_THRUST_SHARE = 0.93  # thrust / weight, so that a measured 1 g means ground
_FALL_SPEED = 0.6   # a faster fall is braked, as far as the velocity is known [m/s]
_GAIN = 4.0         # braking per speed ... [1/s]
_BRAKING = 5.0      # ... and at most so much [m/s^2]
_IMPACT = 25.0      # specific force upwards that counts as hitting the ground: no thrust of this descent is near [m/s^2]
_LEVELLING = 0.3    # rate at which the accelerometer corrects the attitude [1/s]
_REST_TIME = 0.3    # 1 g for so long: on the ground [s]
_SETTLE_TIME = 0.3  # duration of the change of thrust at the beginning [s]
_MEAN_TIME = 0.1    # of the specific force [s]
_LEAK = 4.0         # the velocity is forgotten with this time constant [s]
_BOUNCE_TIME = 0.5  # after a touch the specific force is not evaluated for so long [s]
_THRUST_SHARE_TOUCHED = 0.4  # thrust / weight after a touch
_PLAUSIBLE_SPEED = 6.0  # a greater velocity is not used [m/s]


@dataclass(frozen=True, slots=True)
class AttitudeByImu:
    """Attitude estimated from gyroscope and accelerometer.

    Attributes:
        q: q_WB xyzw, 4 floats.
        w: body rates of the last sample [rad/s], 3 floats.
    """

    q: tuple[float, ...]
    w: tuple[float, ...] = (0.0, 0.0, 0.0)

    def after(self, gyro: tuple[float, ...], accel: tuple[float, ...], dt: float) -> AttitudeByImu:
        """The attitude after one IMU sample.

        Args:
            gyro: angular velocity in B [rad/s].
            accel: specific force in B [m/s^2]; its direction is taken as vertical while its magnitude is near 1 g.
            dt: time since the last sample [s].
        """
        n = sqrt(accel[0] ** 2 + accel[1] ** 2 + accel[2] ** 2)
        correction = (0.0, 0.0, 0.0)
        if 0.8 * GRAVITY < n < 1.2 * GRAVITY:
            b1, b2, b3 = axes_of(self.q)
            correction = cross((accel[0] / n, accel[1] / n, accel[2] / n), (b1[2], b2[2], b3[2]))
        phi = tuple(dt * (gyro[i] + _LEVELLING * correction[i]) for i in range(3))
        return AttitudeByImu(turned(self.q, phi), tuple(gyro))


class BlindDescent:
    """Controller of the descent; owns the attitude estimate and detects ground contact.

    Attributes:
        attitude, v_W: estimated attitude, and velocity in W [m/s].
        landed: whether the ground carries the vehicle.
        age: time over which it has taken IMU samples [s]; a jump of the stamps does not count.
    """

    def __init__(self, vehicle: Vehicle, gains: ControlGains, q: tuple[float, ...], w: tuple[float, ...], stamp: float,
                 now: float, v: tuple[float, ...] = (0.0, 0.0, 0.0)) -> None:
        """
        Args:
            vehicle: model with the thrust observed in flight.
            gains: attitude gains.
            q, w, v: last trusted attitude (xyzw), body rates [rad/s] and velocity in W [m/s]; v is zero where it is not trusted.
            stamp: time of q, w and v [s].
            now: time at which the descent begins [s]; earlier samples only update attitude and velocity.
        """
        self._gains, self._constants = gains, packed_vehicle(vehicle)
        self._mass = vehicle.mass
        self.attitude = AttitudeByImu(tuple(q), tuple(w))
        self.v_W = tuple(v) if norm(v) < _PLAUSIBLE_SPEED else (0.0, 0.0, 0.0)
        self._stamp, self._start = stamp, now
        self._rest, self._f_B = Debounce(_REST_TIME), (0.0, 0.0, GRAVITY)
        self._touched: float | None = None  # when the ground was hit [s]
        self.landed, self.age = False, 0.0

    def imu(self, stamp: float, gyro: tuple[float, ...], accel: tuple[float, ...]) -> None:
        """Take one IMU sample: time [s], angular velocity [rad/s] and specific force [m/s^2] in B."""
        dt = min(max(stamp - self._stamp, 0.0), 0.02)
        self.attitude = self.attitude.after(gyro, accel, dt)
        self._stamp, self.age = stamp, self.age + dt
        b1, b2, b3 = axes_of(self.attitude.q)
        f_W = axpy(accel[0], b1, axpy(accel[1], b2, scale(accel[2], b3)))
        self.v_W = axpy(dt, (f_W[0], f_W[1], f_W[2] - GRAVITY), scale(1.0 - dt / _LEAK, self.v_W))
        # On the ground the accelerometer reads 1 g; in this descent, while it brakes nothing, `_THRUST_SHARE` of it.
        middle = 0.5 * (1.0 + _THRUST_SHARE) * GRAVITY
        # The mean of the vector: vibration is ten times the difference, and would lengthen a mean of lengths.
        self._f_B = axpy(dt / _MEAN_TIME, axpy(-1.0, self._f_B, accel), self._f_B)
        force = norm(self._f_B)
        transient_over = stamp - self._start > _SETTLE_TIME
        quiet = norm(self._specific_thrust()) < middle and norm(gyro) < 0.5
        resting = self._rest.update(transient_over and quiet and middle < force < 1.1 * GRAVITY, stamp)
        if transient_over and f_W[2] > _IMPACT:  # a wall pushes sideways, the ground upwards
            self._touched = stamp
        elif self._touched is not None and stamp - self._touched > _BOUNCE_TIME and force < 0.7 * GRAVITY:
            self._touched = None  # nothing carries the vehicle
        self.landed = self.landed or resting

    def _specific_thrust(self) -> tuple[float, float, float]:
        """Wanted thrust per mass in W [m/s^2]: horizontal speed and climb are braked, the speed of the fall is bounded."""
        vx, vy, vz = self.v_W
        if self._touched is not None:  # held upright by the rotors until it has come to rest
            return 0.0, 0.0, _THRUST_SHARE_TOUCHED * GRAVITY
        across = limited((-_GAIN * vx, -_GAIN * vy, 0.0), _BRAKING)
        fall = min(_GAIN * max(-vz - _FALL_SPEED, 0.0), _BRAKING)
        climb = min(_GAIN * max(vz, 0.0), _BRAKING)
        return across[0], across[1], _THRUST_SHARE * GRAVITY + fall - climb

    def wrench(self) -> tuple[float, float, float, float]:
        """Wanted collective thrust [N] and moments in B [N m]."""
        q, w = self.attitude.q, self.attitude.w
        b1, b2, b3 = axes_of(q)
        f_W = self._specific_thrust()
        d = scale(1.0 / norm(f_W), f_W)
        d_B = (dot(b1, d), dot(b2, d), dot(b3, d))
        # e_R of the shortest turn from b3 to d, 2 sin(angle / 2) about b3 x d in B; it leaves the heading free.
        lean = norm((d_B[0], d_B[1], 0.0))
        half = sqrt(max(0.5 * (1.0 - d_B[2]), 0.0))
        e_R = scale(2.0 * half / lean, (d_B[1], -d_B[0], 0.0)) if lean > 1e-9 else (2.0 * half, 0.0, 0.0)
        g = self._gains
        M = moment(w, e_R, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), self._constants[0][1:4], g.attitude, g.rate, (0.0, 0.0, 0.0))
        thrust = self._mass * f_W[2] / max(b3[2], 0.5) if b3[2] > 0.0 else 0.2 * self._mass * GRAVITY
        return (thrust, *M)

    def rotors(self, speed: tuple[float, ...]) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Rotor commands [rad/s] and the thrusts that they reach [N], from the present rotor speeds."""
        return rotors_for(self.wrench(), speed, self._constants, self._gains.lead)
