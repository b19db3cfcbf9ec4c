"""Monitors that the supervisor evaluates while the motors run."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import acos, degrees, dist, hypot

from perch_core.vehicle import GRAVITY
from perch_control.flight_settings import FlightSettings
from perch_control.debounce import Debounce
from perch_control.reference import Setpoint

TILT_MARGIN = 45.0  # tilt away from the reference's thrust direction that nothing planned explains [deg]
_RATE_FACTOR = 1.6  # the same for the body rate, over the vehicle's body_rate_max
_FAULT_TIME = 0.12  # tilt, rate or position deviate for so long before the supervisor acts [s]
_MARGIN_MIN = 0.02  # thrust margin below which the rotors are at their limit ...
_MARGIN_TIME = 1.0  # ... for so long: a turn is shorter [s]
DOWN_TIME = 1.0     # at rest and tilted for so long: something else carries the vehicle [s]
_MEAN_TIME = 0.05   # time constant of the mean of the IMU samples [s]
_BALANCED = 0.15    # tolerance of the specific force of a carried vehicle around gravity, as a share of it
_TILTED = 0.5       # cosine of the tilt beyond which no vehicle hovers
_QUIET = 0.5        # largest body rate of a carried vehicle [rad/s]


def reference_tilt_deg(state: tuple[float, ...], setpoint: Setpoint) -> float:
    """Angle between b3 and the reference's [deg], or its thrust direction where it has no b3; 0 in free fall then."""
    fx, fy, fz = setpoint.b3
    if hypot(fx, fy, fz) < 0.5:
        fx, fy, fz = setpoint.a[0], setpoint.a[1], setpoint.a[2] + GRAVITY
    n = hypot(fx, fy, fz)
    if n < 0.5:
        return 0.0
    x, y, z, w = state[6:10]
    along = 2.0 * (x * z + y * w) * fx + 2.0 * (y * z - x * w) * fy + (1.0 - 2.0 * (x * x + y * y)) * fz  # b3 . f
    return degrees(acos(min(max(along / n, -1.0), 1.0)))


@dataclass
class TrackingMonitor:
    """Monitor of tilt, body rate and position against the plan, of the thrust margin and of the geofence."""

    settings: FlightSettings
    rate_max: float
    _tilt: Debounce = field(init=False)
    _rate: Debounce = field(init=False)
    _position: Debounce = field(init=False)
    _margin: Debounce = field(init=False)

    def __post_init__(self) -> None:
        self._tilt, self._rate, self._position = (Debounce(_FAULT_TIME) for _ in range(3))
        self._margin = Debounce(_MARGIN_TIME)

    def deviation(self, state: tuple[float, ...], setpoint: Setpoint, now: float) -> str:
        """Return the deviation from the plan that has lasted too long; empty: none."""
        tilt = reference_tilt_deg(state, setpoint)
        rate = hypot(*state[10:13])
        error = dist(setpoint.p, state[0:3])
        tilted = self._tilt.update(tilt > TILT_MARGIN, now)
        spinning = self._rate.update(rate > _RATE_FACTOR * self.rate_max, now)
        away = self._position.update(error > self.settings.position_error_max, now)
        if tilted:
            return f"tilt {tilt:.0f} deg away from the plan's"
        if spinning:
            return f"body rate {rate:.1f} rad/s beyond any plan's"
        return f"{error:.2f} m away from the reference" if away else ""

    def exhausted(self, margin: float, now: float) -> bool:
        """Whether the rotors have been at their limit for too long."""
        return self._margin.update(margin < _MARGIN_MIN, now)

    def outside(self, p: tuple[float, ...]) -> float:
        """Distance by which a position is outside the geofence [m], 0 inside."""
        s = self.settings
        (x, y, z), (a, b, c), (d, e, f) = p, s.fence_low, s.fence_high
        return max(0.0, a - x, x - d, b - y, y - e, c - z, z - f)


class TiltedContactMonitor:
    """Detects from the IMU alone that something other than the rotors carries the vehicle, at a tilt at which it cannot hover.

    The rotors act on the specific force along b3. Where its magnitude is that of gravity for a long time and it does not point
    along b3, a wall or the ground carries the vehicle, whatever the odometry. No attitude is needed, so that this also works in a
    descent without position, and upside down after a fall.

    Attributes:
        tilted: whether the specific force does not point along b3.
        confirmed: whether the vehicle has been carried like this for `DOWN_TIME`.
    """

    def __init__(self) -> None:
        self._held = Debounce(DOWN_TIME)
        self._force, self._rate, self._stamp = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0
        self.tilted = self.confirmed = False

    def imu(self, stamp: float, gyro: tuple[float, ...], accel: tuple[float, ...]) -> None:
        """Take an IMU sample: time [s], angular velocity [rad/s] and specific force [m/s^2] in B."""
        share = min(max(stamp - self._stamp, 0.0) / _MEAN_TIME, 1.0)
        self._stamp = stamp
        self._force, self._rate = _interpolated(self._force, accel, share), _interpolated(self._rate, gyro, share)
        length = hypot(*self._force)
        self.tilted = self._force[2] < _TILTED * length
        carried = self.tilted and abs(length - GRAVITY) < _BALANCED * GRAVITY and hypot(*self._rate) < _QUIET
        self.confirmed = self._held.update(carried, stamp)


def _interpolated(a: tuple[float, ...], b: tuple[float, ...], share: float) -> tuple[float, float, float]:
    """Return the point at a fraction of the way from one vector to another."""
    x, y, z = a
    return x + share * (b[0] - x), y + share * (b[1] - y), z + share * (b[2] - z)
