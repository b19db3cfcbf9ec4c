"""Landing on rotors that are too weak to continue: level, slow, and braked as well as the remaining thrust allows.

Height has priority: the vehicle leans only as far as its weight is still carried, or by a small angle where it is not. Where it
falls too fast, it leans by 2 deg at most; it is also level at touchdown, since a rotor that touches the ground first breaks.
"""

from __future__ import annotations

from math import acos, radians, sin, sqrt

from perch_control.guidance import horizontal
from perch_control.recovery import towards
from perch_control.reference import ByState, Setpoint
from perch_core.vector3 import axes_of, limited, scale
from perch_core.vehicle import GRAVITY

_GAIN = 8.0        # of the vertical speed [1/s]
_SIDE_GAIN = 4.0   # of the horizontal speed [1/s]
_SHARE_MIN = 0.6   # thrust / weight at least, so that the rotors keep their moment
_LEVEL = 0.08      # level below this height [m], and ...
_PER_HEIGHT = 1.5  # ... leaning by at most so much per height above it [rad/m]
_LEAN_MIN = radians(2.0)   # [rad]
_NEARLY_UPRIGHT = 0.9
_TURN_AHEAD = 0.08  # angle by which the commanded direction leads the present one [rad]
_LEAN = radians(15.0)      # it leans so far to brake its horizontal speed, or as far as the weight is still carried ... [rad]
_LEAN_MAX = radians(30.0)  # ... but no further than this [rad]
_TOUCH_SPEED = 1.2         # it does not lean where it would touch the ground faster than this [m/s]
_DELAY = 0.1       # until the rotors have answered [s]


class WeakLanding(ByState):
    """Guidance by the present state; in each period, `update` is called before `setpoint`."""

    def __init__(self, speed: float, state: tuple[float, ...], ground: float) -> None:
        """
        Args:
            speed: descent speed [m/s].
            state: initial state, 13 floats (p, v, q, w).
            ground: height at which the vehicle was armed [m].
        """
        self._speed, self._ground = speed, ground
        self._setpoint = Setpoint(state[0:3], state[3:6], h=horizontal(axes_of(state[6:10])[1]))

    def update(self, state: tuple[float, ...], specific_thrust_max: float) -> None:
        """Compute the demand from the present state and the greatest remaining collective thrust / mass [m/s^2]."""
        p, v, thrust_max = state[0:3], state[3:6], specific_thrust_max
        carried = acos(min(GRAVITY / thrust_max, 1.0))
        lean = min(max(carried, _LEAN), _LEAN_MAX)
        height = p[2] - self._ground
        fall = max(v[2] ** 2 - _TOUCH_SPEED**2, 0.0) if v[2] < 0.0 else 0.0
        needed = (GRAVITY + 0.5 * fall / max(height + _DELAY * v[2], 0.05)) / thrust_max  # thrust that stops the fall, as a share
        lean = min(lean, acos(min(needed, 1.0))) if fall > 0.0 else lean
        lean = max(min(lean, _PER_HEIGHT * (height - _LEVEL)), _LEAN_MIN)
        side = limited((-_SIDE_GAIN * v[0], -_SIDE_GAIN * v[1], 0.0), thrust_max * sin(lean))
        top = sqrt(max(thrust_max**2 - side[0] ** 2 - side[1] ** 2, 0.0))
        up = min(max(GRAVITY - _GAIN * (v[2] + self._speed), _SHARE_MIN * GRAVITY), top)
        f = (side[0], side[1], up)
        b1, _, b3 = axes_of(state[6:10])
        if fall > 0.0 and b3[2] > _NEARLY_UPRIGHT:  # moments cost thrust, the small tilt costs less: turn gently
            direction = towards(f, b1, b3, _TURN_AHEAD)
            f = scale(thrust_max, direction) if direction is not None else f
        self._setpoint = Setpoint(p, v, (f[0], f[1], f[2] - GRAVITY), h=self._setpoint.h)

    def resting(self, state: tuple[float, ...]) -> bool:
        """Whether the commanded descent does not take place, because something carries the vehicle."""
        return abs(state[5]) < min(0.1, 0.5 * self._speed)
