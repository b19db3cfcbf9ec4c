"""What the vehicle shall do at a time: setpoints, and the sources that give them.

A source is anything with `duration` and `setpoint(t)`, t in seconds since its start.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from perch_core import bernstein, so3
from perch_core.arrays import vector3
from perch_core.flatness import heading_derivatives
from perch_core.jit import compiled
from perch_core.trajectory import FlatTrajectory, SampledTrajectory
from perch_core.vehicle import GRAVITY

Vector = tuple[float, ...]
"""3 floats."""
_ZERO = (0.0, 0.0, 0.0)


class Setpoint(NamedTuple):
    """Wanted motion at one time; every vector in W, 3 floats.

    Attributes:
        p, v, a, j, s: position and its derivatives [m, m/s, m/s^2, m/s^3, m/s^4].
        h, dh, ddh: wanted direction of b2 (b2_des of [M:eq12]) and its derivatives. A vector, not an angle: a reference
            attitude gives it without singularity, whatever the tilt.
        b3, db3, ddb3: wanted direction of b3 and its derivatives; zero: that of the specific force a + g e3. A plan that
            carries its attitude gives it also where there is hardly a force to tell it from.
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
    """The fields of a `Setpoint`, 11 vectors, of its packed form (33,)."""
    return (
        (row[0], row[1], row[2]), (row[3], row[4], row[5]), (row[6], row[7], row[8]), (row[9], row[10], row[11]),
        (row[12], row[13], row[14]), (row[15], row[16], row[17]), (row[18], row[19], row[20]), (row[21], row[22], row[23]),
        (row[24], row[25], row[26]), (row[27], row[28], row[29]), (row[30], row[31], row[32]),
    )


class Source(Protocol):
    """A reference: setpoints over the time since its start, and how long it lasts [s]."""

    @property
    def duration(self) -> float: ...

    def setpoint(self, t: float) -> Setpoint:
        """Setpoint at a time [s]."""


class Following(Protocol):
    """A running reference: its source, the time since it began, and its setpoint some time from now."""

    @property
    def source(self) -> Source: ...

    @property
    def elapsed(self) -> float: ...

    def setpoint(self, ahead: float = 0.0) -> Setpoint:
        """Setpoint `ahead` seconds from now."""


class ByState:
    """A reference that is guidance by the state: a function of the state that it was given last, with nothing to be previewed."""

    duration = float("inf")


class Resting:
    """Hover at the origin: a reference for warming up."""

    elapsed = 0.0
    duration = 0.0

    @property
    def source(self) -> Resting:
        """Itself."""
        return self

    def setpoint(self, ahead: float = 0.0) -> Setpoint:
        """The same at every time."""
        return Setpoint((0.0, 0.0, 0.0))


@compiled
def flat_setpoints(tables, edges, durations, choose, times, out):
    """Setpoints of a flat trajectory (`FlatTrajectory.arrays`) at times [s], shape (n,): packed, in `out`, shape (n, 33).

    Past the end the last acceleration holds: a contact is being awaited there.
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
    """`flat_setpoints` at one time [s], as `fields`: without arrays between here and the interpreter."""
    times, out = np.empty(1), np.empty((1, 33))
    times[0] = t
    flat_setpoints(tables, edges, durations, choose, times, out)
    return fields(out[0])


@dataclass(frozen=True)
class FlatReference:
    """A polynomial in the flat outputs."""

    trajectory: FlatTrajectory

    @property
    def duration(self) -> float:
        """[s]"""
        return self.trajectory.duration

    def many(self, times: np.ndarray) -> np.ndarray:
        """Setpoints at many times [s], packed, shape (n, 33)."""
        out = np.empty((len(times), 33))
        flat_setpoints(*self.trajectory.arrays, times, out)
        return out

    def setpoint(self, t: float) -> Setpoint:
        """Setpoint at a time [s]. Past the end the last acceleration holds: a contact is being awaited there."""
        return Setpoint._make(_flat_setpoint(*self.trajectory.arrays, t))


def with_unit_quaternions(trajectory: SampledTrajectory) -> SampledTrajectory:
    """The same with unit quaternions where anybody's quaternions need it; what has been normalised stays as it is to the last bit."""
    off = np.abs(np.linalg.norm(trajectory.q, axis=1) - 1.0).max()
    return trajectory if off < 1e-9 else trajectory.normalised()


@dataclass(frozen=True)
class SampledReference:
    """Full states with rotor thrusts, brought to the same form: jerk and snap follow from the attitude's motion and the
    collective thrust, b2_des and b3 from the reference attitude."""

    trajectory: SampledTrajectory
    mass: float

    @property
    def duration(self) -> float:
        """[s]"""
        return self.trajectory.duration

    def setpoint(self, t: float) -> Setpoint:
        """Setpoint at a time [s]; past the end the last acceleration holds."""
        end = self.trajectory.duration
        x = self.trajectory.sample(t)
        R = so3.quat_to_matrix(x.q)
        w, dw = x.w, x.dw
        over = max(t - end, 0.0)
        specific = float(np.sum(x.rotor_thrust)) / self.mass
        span = 0.5 * float(self.trajectory.times[1] - self.trajectory.times[0])
        before, after = max(t - span, 0.0), min(t + span, end)
        rate = 0.0
        if over > 0.0:
            w, dw = np.zeros(3), np.zeros(3)
        elif after > before:
            change = self.trajectory.sample(after).rotor_thrust - self.trajectory.sample(before).rotor_thrust
            rate = float(np.sum(change)) / (after - before) / self.mass
        W = so3.hat(w)
        turn, turn2 = R @ W, R @ (W @ W + so3.hat(dw))  # R', R''
        b3, db3, ddb3 = R[:, 2], turn[:, 2], turn2[:, 2]
        a = specific * b3 - np.array([0.0, 0.0, GRAVITY])
        j = rate * b3 + specific * db3
        s = 2.0 * rate * db3 + specific * ddb3
        p, v = x.p + over * (x.v + 0.5 * over * a), x.v + over * a
        return Setpoint(vector3(p), vector3(v), vector3(a), vector3(j), vector3(s), vector3(R[:, 1]),
                        vector3(turn[:, 1]), vector3(turn2[:, 1]), vector3(b3), vector3(db3), vector3(ddb3))


def peak_thrust(source, begin: float) -> float:
    """Greatest specific thrust that a source asks for from a time on, to its end [m/s^2]; sampled every 40 ms."""
    times = np.append(np.arange(begin, source.duration, 0.04), max(source.duration, begin))
    a = packed_many(source, times)[:, 6:9] + (0.0, 0.0, GRAVITY)
    return float(np.linalg.norm(a, axis=1).max())


def packed_many(source, times: np.ndarray) -> np.ndarray:
    """Setpoints of a source at many times [s], packed, shape (n, 33); sources that have `many` are evaluated in one go."""
    if hasattr(source, "many"):
        return source.many(times)
    return np.array([source.setpoint(float(t)).packed for t in times])
