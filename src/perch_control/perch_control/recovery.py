"""Recovery to a hover from any attitude: push away from the surface, turn upright, then stop.

After a missed perch the vehicle is tilted beside the wall and falls. Turning upright moves the upper edge of its body
towards the wall by its radius, so the vehicle pushes off first. It then turns with full moment *and* with high thrust:
while the thrust points away from the wall, it increases the clearance; in the second half of the turn, it brakes the fall. The
commanded direction leads the present one by a bounded angle, which keeps most of the thrust while the moment is saturated.
Below a surface that faces down, the fall itself leads away, and thrust would add to it: there is no push, and while b3 points down
the thrust is low, but for what the moments need.
"""

from __future__ import annotations

from copy import copy
from math import cos, radians, sin

from perch_core.vector3 import axes_of, axpy, dot, limited, norm, scale
from perch_core.vehicle import GRAVITY
from perch_control.guidance import horizontal
from perch_control.reference import ByState, Setpoint, Vector


TIMEOUT = 6.0          # a recovery that has not come to rest by then descends [s]
_PUSH_TIME = 0.04      # longest push away from the surface [s]
_PUSH_CLEARANCE = 0.1  # the push ends at this distance from where contact was missed [m]
_THRUST_SHARE = 0.95   # of the greatest thrust while pushing and turning: the rest is left to the moments
_DOWN_SHARE = 0.25     # the same while b3 points down
_OVERHANG = -0.3       # vertical component of the normal of a surface below which there is no push
_TURN_AHEAD = 50.0     # the commanded direction leads the present one by so much: enough to saturate the moment [deg]
_AWAY_SPEED = 0.5      # away from the surface until the clearance is reached [m/s]
_AWAY_DISTANCE = 0.5   # from the surface to the hover: three radii of the smaller vehicle [m]
_VELOCITY_GAIN = 6.0   # [1/s]
_CLIMB_GAIN = 1.0      # vertical speed per height lost [1/s]
_CLIMB_SPEED = 1.0     # at most [m/s]
_SIDE_MAX = 4.0        # horizontal acceleration: leans by 22 deg at most once upright [m/s^2]
_LEVEL = 25.0          # hand-over to hover below this tilt ... [deg]
_RATE = 3.0            # ... this body rate ... [rad/s]
_SPEED = 0.8           # ... and this speed, from which a brake follows the vehicle [m/s]


def towards(f: Vector, b1: Vector, b3: Vector, ahead: float) -> Vector | None:
    """Return the direction at an angle `ahead` [rad] from b3 on the shortest turn to `f`; None: `f` is within that angle."""
    if dot(b3, f) >= cos(ahead) * norm(f):
        return None
    across: Vector = axpy(-dot(b3, f), b3, f)
    across = scale(1.0 / norm(across), across) if norm(across) > 1e-6 * norm(f) else b1  # opposite ones turn about b2
    return axpy(sin(ahead), across, scale(cos(ahead), b3))


class Recovery(ByState):
    """Guidance by the present state; in each period, `update` is called before `setpoint`.

    Attributes:
        finished: whether the vehicle is upright and slow, and away from the surface.
    """

    def __init__(self, specific_thrust_max: float, state: tuple[float, ...], normal: Vector | None) -> None:
        """
        Args:
            specific_thrust_max: greatest collective thrust / mass [m/s^2].
            state: initial state, 13 floats (p, v, q, w).
            normal: outward normal of the surface at `state`; None: there is none.
        """
        self._thrust_max = specific_thrust_max
        self._origin, self._normal = state[0:3], normal
        self._push = normal if normal is not None and _OVERHANG <= normal[2] < cos(radians(30.0)) else None
        _, self._h, _ = axes_of(state[6:10])
        self._setpoint = Setpoint(state[0:3], state[3:6], h=self._h)
        self.finished = False

    def update(self, state: tuple[float, ...], elapsed: float) -> None:
        """Compute the demand from the present state, `elapsed` seconds after the start."""
        p, v, w = state[0:3], state[3:6], state[10:13]
        b1, b2, b3 = axes_of(state[6:10])
        moved = axpy(-1.0, self._origin, p)
        clearance = dot(moved, self._normal) if self._normal is not None else _AWAY_DISTANCE
        if elapsed > _PUSH_TIME or clearance > _PUSH_CLEARANCE:
            self._push = None
        if self._push is not None:
            f = scale(_THRUST_SHARE * self._thrust_max, self._push)
            self._setpoint = Setpoint(p, v, (f[0], f[1], f[2] - GRAVITY), h=self._h)
            return
        rise = _AWAY_DISTANCE * self._normal[2] if self._normal is not None else 0.0
        climb = min(max(_CLIMB_GAIN * (rise - moved[2]), -_CLIMB_SPEED), _CLIMB_SPEED)
        away: Vector = (0.0, 0.0, 0.0)
        if self._normal is not None and clearance < _AWAY_DISTANCE:
            nx, ny, _ = self._normal
            away = scale(_AWAY_SPEED, (nx, ny, 0.0))
        demand = axpy(-_VELOCITY_GAIN, v, scale(_VELOCITY_GAIN, (away[0], away[1], climb)))
        side = limited((demand[0], demand[1], 0.0), _SIDE_MAX)
        up = min(max(demand[2], -0.4 * GRAVITY), _THRUST_SHARE * self._thrust_max - GRAVITY)
        f = (side[0], side[1], up + GRAVITY)
        direction = towards(f, b1, b3, radians(_TURN_AHEAD))
        if direction is not None:
            f = scale((_THRUST_SHARE if b3[2] >= 0.0 else _DOWN_SHARE) * self._thrust_max, direction)
        # Turning upright, the heading can wait: b2 stays where it is.
        h = b2 if b3[2] < 0.5 else horizontal(b2)
        self._setpoint = Setpoint(p, v, (f[0], f[1], f[2] - GRAVITY), h=h)
        self.finished = (b3[2] > cos(radians(_LEVEL)) and norm(w) < _RATE and norm(v) < _SPEED
                         and clearance >= 0.5 * _AWAY_DISTANCE)

    def moved(self, p: Vector) -> Recovery:
        """Return the recovery after a jump of the odometry to `p` [m]: clearance and lost height are kept."""
        after = copy(self)
        after._origin = axpy(1.0, p, axpy(-1.0, self._setpoint.p, self._origin))
        return after
