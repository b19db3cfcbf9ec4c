"""The way back to a hover from any attitude: away from the surface, upright, then stop.

After a missed perch the vehicle lies tilted beside the wall and falls. Turning upright moves the upper edge of its body
towards the wall by its radius, so it pushes off first; then it turns with all the moment there is *and* with high thrust:
as long as the thrust points away from the wall it makes room, and from half way up it brakes the fall. The commanded
direction leads the present one by a bounded angle, which keeps most of the thrust while the moment is saturated.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar
from math import cos, radians, sin

from perch_core.config import quantity
from perch_core.vector3 import axes_of, axpy, dot, limited, norm, scale
from perch_core.vehicle import GRAVITY
from perch_control.guidance import horizontal
from perch_control.reference import Setpoint, Vector


@dataclass(frozen=True)
class RecoverySettings:
    """How a recovery flies."""

    push_time: ClassVar[float] = 0.04  # longest push away from the surface [s]
    push_clearance: ClassVar[float] = 0.10  # the push ends at this distance from where contact was missed [m]
    thrust_share: ClassVar[float] = 0.95  # share of the greatest thrust while pushing and turning
    turn_ahead_deg: ClassVar[float] = 50.0  # the commanded direction leads the present one by so much [deg]
    away_speed: ClassVar[float] = 0.5  # speed away from the surface until the clearance is reached [m/s]
    away_distance: float = quantity(0.5, unit="m", low=0.0, doc="distance from the surface at which to hover")
    velocity_gain: ClassVar[float] = 6.0  # [1/s]
    climb_gain: ClassVar[float] = 1.0  # vertical speed per height lost [1/s]
    climb_speed_max: ClassVar[float] = 1.0  # [m/s]
    acceleration_max: ClassVar[float] = 4.0  # horizontal [m/s^2]
    level_deg: ClassVar[float] = 25.0  # hand-over to hover below this tilt ... [deg]
    rate: ClassVar[float] = 3.0  # ... this body rate ... [rad/s]
    speed: ClassVar[float] = 0.8  # ... and this speed [m/s]
    timeout: ClassVar[float] = 6.0  # then descend [s]


def towards(f: Vector, b1: Vector, b3: Vector, ahead: float) -> Vector | None:
    """The direction that is `ahead` [rad] from b3 on the shortest turn to `f`; None: `f` is nearer than that."""
    if dot(b3, f) >= cos(ahead) * norm(f):
        return None
    across: Vector = axpy(-dot(b3, f), b3, f)
    across = scale(1.0 / norm(across), across) if norm(across) > 1e-6 * norm(f) else b1  # opposite ones turn about b2
    return axpy(sin(ahead), across, scale(cos(ahead), b3))


class Recovery:
    """Guidance from the present state; `update` first in each period, then `setpoint`."""

    duration = float("inf")
    by_state = True  # a function of the state, with nothing to be previewed

    def __init__(self, settings: RecoverySettings, specific_thrust_max: float, state: tuple[float, ...],
                 normal: Vector | None) -> None:
        """
        Args:
            settings: how to fly.
            specific_thrust_max: greatest collective thrust / mass [m/s^2].
            state: where the recovery begins, 13 floats (p, v, q, w).
            normal: outward normal of the surface at `state`, None: in the open.
        """
        self._settings, self._thrust_max = settings, specific_thrust_max
        self._origin, self._normal = state[0:3], normal
        self._push = None if normal is None or normal[2] >= cos(radians(30.0)) else normal
        _, self._h, _ = axes_of(state[6:10])
        self._setpoint = Setpoint(state[0:3], state[3:6], h=self._h)
        self.finished = False

    def update(self, state: tuple[float, ...], elapsed: float) -> None:
        """Take the present state, `elapsed` seconds after the beginning."""
        s = self._settings
        p, v, w = state[0:3], state[3:6], state[10:13]
        b1, b2, b3 = axes_of(state[6:10])
        moved = axpy(-1.0, self._origin, p)
        clearance = dot(moved, self._normal) if self._normal is not None else s.away_distance
        if elapsed > s.push_time or clearance > s.push_clearance:
            self._push = None
        if self._push is not None:
            f = scale(s.thrust_share * self._thrust_max, self._push)
            self._setpoint = Setpoint(p, v, (f[0], f[1], f[2] - GRAVITY), h=self._h)
            return
        climb = min(max(-s.climb_gain * moved[2], -s.climb_speed_max), s.climb_speed_max)
        away: Vector = (0.0, 0.0, 0.0)
        if self._normal is not None and clearance < s.away_distance:
            nx, ny, _ = self._normal
            away = scale(s.away_speed, (nx, ny, 0.0))
        demand = axpy(-s.velocity_gain, v, scale(s.velocity_gain, (away[0], away[1], climb)))
        side = limited((demand[0], demand[1], 0.0), s.acceleration_max)
        up = min(max(demand[2], -0.4 * GRAVITY), s.thrust_share * self._thrust_max - GRAVITY)
        f = (side[0], side[1], up + GRAVITY)
        direction = towards(f, b1, b3, radians(s.turn_ahead_deg))
        if direction is not None:
            f = scale(s.thrust_share * self._thrust_max, direction)
        # Turning upright, the heading can wait: b2 stays where it is.
        h = b2 if b3[2] < 0.5 else horizontal(b2)
        self._setpoint = Setpoint(p, v, (f[0], f[1], f[2] - GRAVITY), h=h)
        self.finished = (b3[2] > cos(radians(s.level_deg)) and norm(w) < s.rate and norm(v) < s.speed
                         and clearance >= 0.5 * s.away_distance)

    def setpoint(self, t: float) -> Setpoint:
        """The demand of the last `update`: an acceleration without position or velocity error."""
        return self._setpoint
