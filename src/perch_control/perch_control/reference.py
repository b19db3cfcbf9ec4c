"""Setpoints (the wanted motion at one time) and the reference sources that provide them.

A source is any object with `duration` and `setpoint(t)`, t in seconds since its start.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np

from perch_core import bernstein
from perch_core.arrays import Array
from perch_core.flatness import heading_derivatives
from perch_core.jit import compiled
from perch_core.trajectory import FlatTrajectory, SampledTrajectory
from perch_core.vector3 import axes_of, axpy, cross, rotation_vector, scale, turned
from perch_core.vehicle import GRAVITY

Vector = tuple[float, ...]
"""3 floats."""
_ZERO = (0.0, 0.0, 0.0)


class Setpoint(NamedTuple):
    """Wanted motion at one time; every vector in W, 3 floats.

    Attributes:
        p, v, a, j, s: position and its derivatives [m, m/s, m/s^2, m/s^3, m/s^4].
        h, dh, ddh: wanted direction of b2 (b2_des of [M:eq12]) and its derivatives. It is a vector instead of an angle, since
            a reference attitude then determines it without singularity at any tilt.
        b3, db3, ddb3: wanted direction of b3 and its derivatives; zero: that of the specific force a + g e3. A plan with
            attitudes sets it, so that it is defined even where the force is close to zero.
    """

    p: Vector
    v: Vector = _ZERO
    a: Vector = _ZERO
    j: Vector = _ZERO
    s: Vector = _ZERO
    h: Vector = (0.0, 1.0, 0.0)
    dh: Vector = _ZERO
    ddh: Vector = _ZERO
    b3: Vector = _ZERO
    db3: Vector = _ZERO
    ddb3: Vector = _ZERO

    @property
    def packed(self) -> tuple[float, ...]:
        """All fields in their order, 33 floats."""
        return (*self.p, *self.v, *self.a, *self.j, *self.s, *self.h, *self.dh, *self.ddh, *self.b3, *self.db3, *self.ddb3)


@compiled
def fields(row):
    """Return the fields of a `Setpoint`, 11 vectors, from its packed form (33,)."""
    return (
        (row[0], row[1], row[2]), (row[3], row[4], row[5]), (row[6], row[7], row[8]), (row[9], row[10], row[11]),
        (row[12], row[13], row[14]), (row[15], row[16], row[17]), (row[18], row[19], row[20]), (row[21], row[22], row[23]),
        (row[24], row[25], row[26]), (row[27], row[28], row[29]), (row[30], row[31], row[32]),
    )


class Source(Protocol):
    """A reference: setpoints as a function of the time since its start, and its duration [s]."""

    @property
    def duration(self) -> float: ...

    def setpoint(self, t: float) -> Setpoint:
        """Setpoint at a time [s]."""


class Following(Protocol):
    """A running reference: its source, the time since its start [s], and its setpoint at a time ahead."""

    @property
    def source(self) -> Source: ...

    @property
    def elapsed(self) -> float: ...

    def setpoint(self, ahead: float = 0.0) -> Setpoint:
        """Setpoint `ahead` seconds from now."""


class ByState:
    """A reference that is guidance by state: a function of the state in its last update, without preview."""

    duration = float("inf")
    _setpoint: Setpoint

    def setpoint(self, t: float) -> Setpoint:
        """Return the demand of the last update: an acceleration with zero position and velocity error."""
        return self._setpoint


@compiled
def flat_setpoints(tables, edges, durations, choose, times, out):
    """Write setpoints of a flat trajectory (`FlatTrajectory.arrays`) at times [s], shape (n,), to `out`, packed, shape (n, 33).

    Past the end, the last acceleration is held, since a contact is awaited there.
    """
    last = len(durations) - 1
    for k in range(len(times)):
        t, index = times[k], 0
        while index < last and edges[index + 1] <= t:
            index += 1
        s = min(max((t - edges[index]) / durations[index], 0.0), 1.0)
        x, row = bernstein.values_at(tables[index], choose, s), out[k]
        row[:] = 0.0
        yaw, rate, acc, over = x[0, 3], x[1, 3], x[2, 3], t - edges[last + 1]
        if over > 0.0:
            rate, acc = 0.0, 0.0
            for i in range(3):
                row[i] = x[0, i] + over * (x[1, i] + 0.5 * over * x[2, i])
                row[3 + i] = x[1, i] + over * x[2, i]
                row[6 + i] = x[2, i]
        else:
            for order in range(5):
                for i in range(3):
                    row[3 * order + i] = x[order, i]
        h, dh, ddh = heading_derivatives(yaw, rate, acc)
        for i in range(3):
            row[15 + i], row[18 + i], row[21 + i] = h[i], dh[i], ddh[i]


@compiled
def _flat_setpoint(tables, edges, durations, choose, t):
    """Return `flat_setpoints` at one time [s], in the form of `fields`: no array is passed to the interpreter."""
    times, out = np.empty(1), np.empty((1, 33))
    times[0] = t
    flat_setpoints(tables, edges, durations, choose, times, out)
    return fields(out[0])


@dataclass(frozen=True)
class FlatReference:
    """A reference given by a piecewise polynomial in the flat outputs."""

    trajectory: FlatTrajectory

    @property
    def duration(self) -> float:
        """Duration [s]."""
        return self.trajectory.duration

    def many(self, times: np.ndarray) -> np.ndarray:
        """Setpoints at many times [s], packed, shape (n, 33)."""
        out = np.empty((len(times), 33))
        flat_setpoints(*self.trajectory.arrays, times, out)
        return out

    def setpoint(self, t: float) -> Setpoint:
        """Setpoint at a time [s]. Past the end, the last acceleration is held, since a contact is awaited there."""
        return Setpoint._make(_flat_setpoint(*self.trajectory.arrays, t))


def with_unit_quaternions(trajectory: SampledTrajectory) -> SampledTrajectory:
    """Return the trajectory with unit quaternions; one that is normalised already is returned unchanged, bit by bit."""
    norm_error = np.abs(np.linalg.norm(trajectory.q, axis=1) - 1.0).max()
    return trajectory if norm_error < 1e-9 else trajectory.normalised()


@compiled
def _sample_index(at, t):
    """Return the index k of the last sample before a time, and the fraction of the interval to the next one."""
    k = min(max(np.searchsorted(at, t, side="right") - 1, 0), len(at) - 2)
    return k, min(max((t - at[k]) / (at[k + 1] - at[k]), 0.0), 1.0)


@compiled
def _between(values, k, u):
    """Linear interpolation between samples k and k + 1, shapes (n, 3) -> 3 floats."""
    return axpy(1.0 - u, values[k], scale(u, values[k + 1]))


@compiled
def _specific_at(at, specific, t):
    k, u = _sample_index(at, t)
    return (1.0 - u) * specific[k] + u * specific[k + 1]


@compiled
def _in_world(b1, b2, b3, c):
    """Components in B as a vector in W."""
    return axpy(c[0], b1, axpy(c[1], b2, scale(c[2], b3)))


@compiled
def _sampled_setpoints(at, p, v, q, w, dw, specific, times, out):
    """Write the setpoints of full states at `at` [s], shape (n,), for `times` [s], shape (m,), to `out`, packed, shape (m, 33).

    With f the specific collective thrust `specific` [m/s^2], shape (n,):

        a = f b3 + g,  j = f' b3 + f b3',  s = 2 f' b3' + f b3'',  b_i' = R (w x e_i),  b_i'' = R (w x (w x e_i) + dw x e_i)
    """
    end, half = at[-1], 0.5 * (at[1] - at[0])
    for m in range(len(times)):
        t = times[m]
        over = max(t - end, 0.0)
        k, u = _sample_index(at, t)
        f, rate, turning, acceleration = _specific_at(at, specific, t), 0.0, _ZERO, _ZERO
        if over == 0.0:
            turning, acceleration = _between(w, k, u), _between(dw, k, u)
            before, after = max(t - half, 0.0), min(t + half, end)
            if after > before:
                rate = (_specific_at(at, specific, after) - _specific_at(at, specific, before)) / (after - before)
        b1, b2, b3 = axes_of(turned(q[k], scale(u, rotation_vector(q[k], q[k + 1]))))
        e2, e3 = cross(turning, (0.0, 1.0, 0.0)), cross(turning, (0.0, 0.0, 1.0))
        dh, db3 = _in_world(b1, b2, b3, e2), _in_world(b1, b2, b3, e3)
        ddh = _in_world(b1, b2, b3, axpy(1.0, cross(turning, e2), cross(acceleration, (0.0, 1.0, 0.0))))
        ddb3 = _in_world(b1, b2, b3, axpy(1.0, cross(turning, e3), cross(acceleration, (0.0, 0.0, 1.0))))
        a = axpy(f, b3, (0.0, 0.0, -GRAVITY))
        velocity = _between(v, k, u)
        position = axpy(over, axpy(0.5 * over, a, velocity), _between(p, k, u))
        parts = (position, axpy(over, a, velocity), a, axpy(rate, b3, scale(f, db3)), axpy(2.0 * rate, db3, scale(f, ddb3)),
                 b2, dh, ddh, b3, db3, ddb3)
        for n in range(11):
            for i in range(3):
                out[m, 3 * n + i] = parts[n][i]


@compiled
def _sampled_setpoint(at, p, v, q, w, dw, specific, t):
    """Return `_sampled_setpoints` at one time [s], in the form of `fields`."""
    times, out = np.empty(1), np.empty((1, 33))
    times[0] = t
    _sampled_setpoints(at, p, v, q, w, dw, specific, times, out)
    return fields(out[0])


@dataclass(frozen=True)
class SampledReference:
    """A reference given by full states with rotor thrusts. Jerk and snap follow from the attitude's motion and the
    collective thrust; b2_des and b3 follow from the reference attitude."""

    trajectory: SampledTrajectory
    mass: float

    @property
    def duration(self) -> float:
        """Duration [s]."""
        return self.trajectory.duration

    @cached_property
    def _arrays(self) -> tuple[Array, Array, Array, Array, Array, Array, Array]:
        x = self.trajectory
        return x.times, x.p, x.v, x.q, x.w, x.dw, x.rotor_thrust.sum(axis=1) / self.mass

    def many(self, times: np.ndarray) -> np.ndarray:
        """Setpoints at many times [s], packed, shape (n, 33)."""
        out = np.empty((len(times), 33))
        _sampled_setpoints(*self._arrays, times, out)
        return out

    def setpoint(self, t: float) -> Setpoint:
        """Setpoint at a time [s]; past the end, the last acceleration is held."""
        return Setpoint._make(_sampled_setpoint(*self._arrays, t))


def peak_thrust(source, begin: float) -> float:
    """Greatest specific thrust that a source demands between `begin` and its end [m/s^2]; sampled every 40 ms."""
    times = np.append(np.arange(begin, source.duration, 0.04), max(source.duration, begin))
    a = packed_many(source, times)[:, 6:9] + (0.0, 0.0, GRAVITY)
    return float(np.linalg.norm(a, axis=1).max())


def packed_many(source, times: np.ndarray) -> np.ndarray:
    """Setpoints of a source at many times [s], packed, shape (n, 33); a source with a method `many` is evaluated in one call."""
    if hasattr(source, "many"):
        return source.many(times)
    return np.array([source.setpoint(float(t)).packed for t in times])
