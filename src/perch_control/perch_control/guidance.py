"""References that the controller makes itself: hold, brake, descend, and the move from one reference to another.

Each has `duration` [s] and `setpoint(t)`; past their duration they hold their end (hover or steady descent).
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from operator import add

import numpy as np

from perch_control.reference import Setpoint, Source, Vector, fields, flat_setpoints, packed_many
from perch_core.jit import compiled
from perch_core.trajectory import FlatTrajectory

LONG = 0.5   # a takeover takes so long, where there is twice as much time [s]
SHORT = 0.3  # a takeover shorter than this asks for more than the vehicle can follow: it uses what time there is [s]
BRAKE_PEAK = 1.875  # peak of the derivative of the quintic 0 -> 1 step, per its duration
BRAKE_HARD = 8.0    # largest deceleration of a brake, where the trajectory leads to a surface [m/s^2]
_BRAKE = 4.0        # the same in the open: leans by 22 deg at most [m/s^2]


@dataclass(frozen=True)
class Hold:
    """Hover at a point with a heading."""

    target: Setpoint
    duration: float = 0.0

    @classmethod
    def at(cls, p, h) -> Hold:
        """Hover at `p` with b2_des `h`, made horizontal."""
        return cls(Setpoint(tuple(float(x) for x in p), h=horizontal(h)))

    def setpoint(self, t: float) -> Setpoint:
        """The same at every time."""
        return self.target


def horizontal(h) -> Vector:
    """b2_des turned into the horizontal plane; a vertical one counts as heading zero."""
    n = float(np.hypot(h[0], h[1]))
    return (float(h[0]) / n, float(h[1]) / n, 0.0) if n > 1e-3 else (0.0, 1.0, 0.0)


class Polynomial:
    """A polynomial in position with a fixed heading; past its end the end velocity goes on."""

    def __init__(self, coefficients: np.ndarray, duration: float, h: Vector) -> None:
        """
        Args:
            coefficients: Bernstein coefficients of x, y, z [m], shape (3, degree + 1).
            duration: [s], > 0.
            h: wanted direction of b2.
        """
        yaw = np.zeros((1, coefficients.shape[1]))
        self._trajectory = FlatTrajectory(np.array([duration]), np.concatenate([coefficients, yaw])[None])
        self.duration, self._h = float(duration), h

    def many(self, times: np.ndarray) -> np.ndarray:
        """Setpoints at many times [s], packed, shape (n, 33); the end velocity goes on past the end."""
        out = np.empty((len(times), 33))
        _moving_on(*self._trajectory.arrays, times, self._h, out)
        return out

    def setpoint(self, t: float) -> Setpoint:
        """Setpoint at a time [s]."""
        return Setpoint._make(_moving_on_at(*self._trajectory.arrays, t, self._h))


@compiled
def _moving_on(tables, edges, durations, choose, times, h, out):
    """As `flat_setpoints`, with b2_des `h` (3 floats) and, past the end, the velocity that was there."""
    end = edges[-1]
    flat_setpoints(tables, edges, durations, choose, np.minimum(times, end), out)
    for k in range(len(times)):
        over = times[k] - end
        if over > 0.0:
            out[k, 0:3] += over * out[k, 3:6]
            out[k, 6:15] = 0.0
        for i in range(3):
            out[k, 15 + i] = h[i]


@compiled
def _moving_on_at(tables, edges, durations, choose, t, h):
    """`_moving_on` at one time [s], as `fields`."""
    times, out = np.empty(1), np.empty((1, 33))
    times[0] = t
    _moving_on(tables, edges, durations, choose, times, h, out)
    return fields(out[0])


def brake(p, v, a, h, v_end=(0.0, 0.0, 0.0), within: float = inf) -> Polynomial:
    """Smooth change of velocity from a moving state to `v_end`, position left free at the end.

    The velocity is a quintic with zero end acceleration and jerk; the way covered is v T / 2 + a T^2 / 10.

    Args:
        p, v, a: where the motion is taken over [m, m/s, m/s^2], shape (3,).
        h: wanted direction of b2; made horizontal.
        v_end: velocity at the end [m/s].
        within: longest duration T [s]: gentle where this is long, at most with `BRAKE_HARD` horizontally and vertically where it is short.
    """
    p, v, a, v_end = (np.array(x, float) for x in (p, v, a, v_end))
    change = v - v_end
    gentle = max(0.4, BRAKE_PEAK * float(np.linalg.norm(change)) / _BRAKE, 0.4 * float(np.linalg.norm(a)) / _BRAKE)
    hardest = BRAKE_PEAK * max(float(np.linalg.norm(change[:2])), abs(float(change[2])), 0.1) / BRAKE_HARD
    T = min(gentle, max(within, hardest))
    velocity = np.stack([v, v + a * T / 5, v + 2 * a * T / 5, v_end, v_end, v_end], axis=-1)
    steps = np.cumsum(velocity, axis=-1) * T / 6
    return Polynomial(p[:, None] + np.concatenate([np.zeros((3, 1)), steps], axis=-1), T, horizontal(h))


def quintic(p0, v0, a0, p1, v1, a1, duration: float) -> np.ndarray:
    """Bernstein coefficients of the quintic with the given ends, shape (3, 6)."""
    p0, v0, a0, p1, v1, a1 = (np.array(x, float) for x in (p0, v0, a0, p1, v1, a1))
    T = duration
    return np.stack([
        p0, p0 + v0 * T / 5, p0 + 2 * v0 * T / 5 + a0 * T**2 / 20,
        p1 - 2 * v1 * T / 5 + a1 * T**2 / 20, p1 - v1 * T / 5, p1,
    ], axis=-1)


@dataclass(frozen=True)
class Blend:
    """A reference with an offset that dies away: a new reference is reached without a jump.

    Attributes:
        source: the reference.
        start: its time at which the offset begins [s].
        offset: what is added, over the time since `start`.
    """

    source: Source
    start: float
    offset: Polynomial

    @property
    def duration(self) -> float:
        """[s]"""
        return self.source.duration

    def many(self, times: np.ndarray) -> np.ndarray:
        """Setpoints at many times [s] of the reference, packed, shape (n, 33)."""
        out, since = packed_many(self.source, times), times - self.start
        acting = (since >= 0.0) & (since < self.offset.duration)
        out[acting, :15] += self.offset.many(since[acting])[:, :15]
        return out

    def setpoint(self, t: float) -> Setpoint:
        """Setpoint at a time [s] of the reference, as `many` has it."""
        x, since = self.source.setpoint(t), t - self.start
        if not 0.0 <= since < self.offset.duration:
            return x
        moved = (tuple(map(add, *pair)) for pair in zip(x[:5], self.offset.setpoint(since)))
        return Setpoint._make((*moved, *x[5:]))


def blended(old: Setpoint, source: Source, start: float, end: float) -> Source:
    """`source` from its time `start` on, taken over from the old setpoint without a jump in position, velocity or
    acceleration, within `LONG` or half of the time to `end`, but no faster than within `SHORT` where there is so much; the source
    itself where it continues the old one exactly."""
    new = source.setpoint(start)
    p, v, a = (np.subtract(*pair) for pair in zip(old[:3], new[:3]))
    if max(float(np.abs(g).max()) for g in (p, v, a)) < 1e-6:
        return source
    zero = np.zeros(3)
    left = end - start
    duration = min(LONG, max(0.5 * left, min(left, SHORT), 0.1))
    return Blend(source, start, Polynomial(quintic(p, v, a, zero, zero, zero, duration), duration, (0.0, 0.0, 0.0)))
