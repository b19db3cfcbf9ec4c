"""What the supervisor watches while motors run."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import acos, degrees

from perch_core.vector3 import axes_of, axpy, dot, norm
from perch_core.vehicle import GRAVITY
from perch_control.flight_settings import FlightSettings
from perch_control.debounce import Debounce
from perch_control.reference import Setpoint

_MEAN_TIME = 0.05  # of what the IMU says [s]
_BALANCED = 0.15   # share of gravity by which the specific force of what is carried may be off it
_TILTED = 0.5      # cosine of the tilt beyond which nothing hovers
_QUIET = 0.5       # rates of what is carried [rad/s]


def reference_tilt_deg(state: tuple[float, ...], setpoint: Setpoint) -> float:
    """Angle between b3 and the thrust direction of the reference [deg]; 0 where the reference is in free fall."""
    f = (setpoint.a[0], setpoint.a[1], setpoint.a[2] + GRAVITY)
    n = norm(f)
    if n < 0.5:
        return 0.0
    _, _, b3 = axes_of(state[6:10])
    return degrees(acos(min(max(dot(b3, f) / n, -1.0), 1.0)))


@dataclass
class TrackingMonitor:
    """Tilt, body rate and position beyond what was planned, thrust margin, geofence."""

    settings: FlightSettings
    rate_max: float
    _tilt: Debounce = field(init=False)
    _rate: Debounce = field(init=False)
    _position: Debounce = field(init=False)
    _margin: Debounce = field(init=False)

    def __post_init__(self) -> None:
        s = self.settings
        self._tilt, self._rate, self._position = (Debounce(s.fault_time) for _ in range(3))
        self._margin = Debounce(s.margin_time)

    def deviation(self, state: tuple[float, ...], setpoint: Setpoint, now: float) -> str:
        """What the vehicle does that was not planned; empty: nothing."""
        s = self.settings
        tilt = reference_tilt_deg(state, setpoint)
        rate = norm(state[10:13])
        error = norm(axpy(-1.0, setpoint.p, state[0:3]))
        tilted = self._tilt.update(tilt > s.tilt_margin_deg, now)
        spinning = self._rate.update(rate > s.rate_factor * self.rate_max, now)
        away = self._position.update(error > s.position_error_max, now)
        if tilted:
            return f"tilt {tilt:.0f} deg away from the plan's"
        if spinning:
            return f"body rate {rate:.1f} rad/s beyond any plan's"
        return f"{error:.2f} m away from the reference" if away else ""

    def exhausted(self, margin: float, now: float) -> bool:
        """The rotors have been at their limit for too long."""
        return self._margin.update(margin < self.settings.margin_min, now)

    def outside(self, p: tuple[float, ...]) -> float:
        """Distance by which a position is outside the geofence [m], 0 inside."""
        s = self.settings
        (x, y, z), (a, b, c), (d, e, f) = p, s.fence_low, s.fence_high
        return max(0.0, a - x, x - d, b - y, y - e, c - z, z - f)


class CarriedTilted:
    """Something other than the rotors carries the vehicle, in an attitude in which it cannot hover; told from the IMU alone.

    What the rotors do to the specific force points along b3. Where it has the length of gravity for long and does not point along
    b3, a wall or the ground does it, whatever odometry says. The attitude need not be known, so that it holds in a descent without
    position as well, and upside down after a fall.
    """

    def __init__(self, settings: FlightSettings) -> None:
        self._settings, self._held = settings, Debounce(settings.down_time)
        self._force, self._rate, self._stamp = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0
        self.lasts = False

    def imu(self, stamp: float, gyro: tuple[float, ...], accel: tuple[float, ...]) -> None:
        """Take an IMU sample: time [s], angular velocity [rad/s] and specific force [m/s^2] in B."""
        share = min(max(stamp - self._stamp, 0.0) / _MEAN_TIME, 1.0)
        self._stamp = stamp
        self._force = axpy(share, axpy(-1.0, self._force, accel), self._force)
        self._rate = axpy(share, axpy(-1.0, self._rate, gyro), self._rate)
        carried = self.tilted and abs(norm(self._force) - GRAVITY) < _BALANCED * GRAVITY and norm(self._rate) < _QUIET
        self.lasts = self._held.update(carried, stamp)

    @property
    def tilted(self) -> bool:
        """What carries the vehicle does not push along b3."""
        return self._force[2] < _TILTED * norm(self._force)
