"""Trajectories that a controller follows: polynomials in the flat outputs, and sampled full states.

Times are seconds since the start of the trajectory; `start_time` is the stamp of that start on the caller's clock.
Times outside [0, duration] are clamped: the first or last sample holds, with all its derivatives.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import accumulate
from math import inf

import numpy as np

from perch_core import bernstein, so3
from perch_core.arrays import Array, Numbers

_DERIVATIVES = 4  # a sample carries position up to snap


@dataclass(frozen=True, slots=True)
class FlatSample:
    """Flat outputs at one time, or at n times (leading axis n).

    Attributes:
        p: position in W [m], shape (3,).
        v: velocity [m/s].
        a: acceleration, gravity not included [m/s^2].
        j: jerk [m/s^3].
        s: snap [m/s^4].
        yaw: heading, b2_des = (-sin yaw, cos yaw, 0) [rad].
        yaw_rate: [rad/s].
        yaw_acc: [rad/s^2].
    """

    p: Array
    v: Array
    a: Array
    j: Array
    s: Array
    yaw: float
    yaw_rate: float
    yaw_acc: float


@dataclass(frozen=True)
class FlatTrajectory:
    """Piecewise polynomial in the flat outputs x, y, z, yaw. [defines M:eq3, M:eq17]

    Attributes:
        durations: segment durations [s], shape (n,).
        coefficients: Bernstein coefficients on each segment's own [0, 1], shape (n, 4, degree + 1) [m, rad].
        start_time: stamp of the start on the caller's clock [s].

    Raises:
        ValueError: wrong shapes, values that are not finite, or durations that are not positive.
    """

    durations: Array
    coefficients: Array
    start_time: float = 0.0
    _edges: list[float] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        durations = np.array(self.durations, float)
        coefficients = np.array(self.coefficients, float)
        if durations.ndim != 1 or not len(durations) or coefficients.shape[:2] != (len(durations), 4) or coefficients.ndim != 3:
            raise ValueError(f"durations {durations.shape} and coefficients {coefficients.shape}: need (n,) and (n, 4, degree + 1)")
        times = durations.tolist()
        if not (np.isfinite(coefficients).all() and all(0.0 < t < inf for t in times)):
            raise ValueError("coefficients must be finite and durations finite and > 0 s")
        for name, value in (("durations", durations), ("coefficients", coefficients)):
            value.setflags(write=False)
            object.__setattr__(self, name, value)
        object.__setattr__(self, "_edges", list(accumulate(times, initial=0.0)))

    @cached_property
    def _tables(self) -> Array:
        """All derivatives in the basis of one degree, so that a sample is one basis and one matrix product.

        Computed by the first sample, because a planner that only publishes its coefficients does not need it.
        """
        tables = np.empty((len(self.durations), _DERIVATIVES + 1, 4, self.degree + 1))
        for order in range(_DERIVATIVES + 1):
            raised = bernstein.elevate(bernstein.derivative(self.coefficients, order), self.degree)
            tables[:, order] = raised / self.durations[:, None, None] ** order
        return tables

    @cached_property
    def arrays(self) -> tuple[Array, Array, Array, Array]:
        """Arguments of kernels: derivatives (n, 5, 4, degree + 1), segment ends (n + 1,) and durations (n,) [s], binomials."""
        return self._tables, np.array(self._edges), np.array(self.durations), bernstein.binomials(self.degree)

    @property
    def duration(self) -> float:
        """Duration of the whole trajectory [s]."""
        return self._edges[-1]

    @property
    def degree(self) -> int:
        """Polynomial degree of the segments."""
        return int(self.coefficients.shape[-1]) - 1

    def locate(self, t: float) -> tuple[int, float]:
        """Segment index and local argument s in [0, 1] of a time [s]; the later segment at a joint."""
        index = min(max(bisect_right(self._edges, t) - 1, 0), len(self.durations) - 1)
        s = (t - self._edges[index]) / self.durations[index]
        return index, min(max(float(s), 0.0), 1.0)

    def sample(self, t: float) -> FlatSample:
        """Flat outputs with their derivatives at one time [s]."""
        values = self.values(t)
        yaw = values[:, 3].tolist()
        return FlatSample(values[0, :3], values[1, :3], values[2, :3], values[3, :3], values[4, :3], *yaw[:3])

    def values(self, t: float) -> Array:
        """(x, y, z, yaw) and their derivatives up to the fourth, one per row, at one time [s]."""
        index, s = self.locate(t)
        return bernstein.values_at(self._tables[index], bernstein.binomials(self.degree), s)

    def sample_many(self, times: Array) -> FlatSample:
        """Flat outputs at many times [s], shape (k,): every field gets the leading axis k."""
        places = [self.locate(float(t)) for t in times]
        rows = bernstein.basis(self.degree, [s for _, s in places])
        values = np.einsum("koda,ka->kod", self._tables[[i for i, _ in places]], rows)
        return FlatSample(*(values[:, order, :3] for order in range(5)), *(values[:, order, 3] for order in range(3)))


@dataclass(frozen=True, slots=True)
class StateSample:
    """Full state at one time; fields as in `SampledTrajectory` without the leading axis."""

    p: Array
    q: Array
    v: Array
    w: Array
    a: Array
    dw: Array
    rotor_thrust: Array


@dataclass(frozen=True)
class SampledTrajectory:
    """Full states at increasing times.

    Attributes:
        times: times since the start [s], shape (n,), increasing from 0.
        p: positions p_WB [m], shape (n, 3).
        q: attitudes q_WB, xyzw, shape (n, 4).
        v: velocities in W [m/s], shape (n, 3).
        w: angular velocities in B [rad/s], shape (n, 3).
        a: accelerations in W, gravity not included [m/s^2], shape (n, 3).
        dw: angular accelerations in B [rad/s^2], shape (n, 3).
        rotor_thrust: [N], shape (n, 4).
        start_time: stamp of the start on the caller's clock [s].

    Raises:
        ValueError: wrong shapes, values that are not finite, or times that do not increase from 0.
    """

    times: Array
    p: Array
    q: Array
    v: Array
    w: Array
    a: Array
    dw: Array
    rotor_thrust: Array
    start_time: float = 0.0

    def __post_init__(self) -> None:
        widths = {"p": 3, "q": 4, "v": 3, "w": 3, "a": 3, "dw": 3, "rotor_thrust": 4}
        times = np.array(self.times, float)
        if times.ndim != 1 or len(times) < 2 or not (np.isfinite(times).all() and abs(times[0]) < 1e-6 and (np.diff(times) > 0.0).all()):
            raise ValueError("times must be at least two, finite, and increase from 0")
        object.__setattr__(self, "times", times)
        for name, width in widths.items():
            value = np.array(getattr(self, name), float)
            if value.shape != (len(times), width) or not np.isfinite(value).all():
                raise ValueError(f"{name}: shape {value.shape} with finite values is needed as ({len(times)}, {width})")
            object.__setattr__(self, name, value)

    @property
    def duration(self) -> float:
        """Duration of the whole trajectory [s]."""
        return float(self.times[-1])

    def sample(self, t: float) -> StateSample:
        """State at a time [s]: linear between samples, attitude along the shortest rotation."""
        t = min(max(t, float(self.times[0])), float(self.times[-1]))
        k = min(max(int(np.searchsorted(self.times, t, side="right")) - 1, 0), len(self.times) - 2)
        u = float((t - self.times[k]) / (self.times[k + 1] - self.times[k]))

        def between(values: Array) -> Array:
            mixed: Array = (1.0 - u) * values[k] + u * values[k + 1]
            return mixed

        q = so3.quat_slerp(self.q[k], self.q[k + 1], u)
        return StateSample(between(self.p), q, between(self.v), between(self.w), between(self.a), between(self.dw),
                           between(self.rotor_thrust))

    def normalised(self) -> SampledTrajectory:
        """Return the trajectory with unit quaternions; those of a plan's samples have rounding errors."""
        return replace(self, q=self.q / np.linalg.norm(self.q, axis=1)[:, None])

    def remainder(self, since: float, offset: Array) -> SampledTrajectory:
        """Return the remainder from a sample on, shifted in position.

        Args:
            since: time [s]; the remainder begins with the last sample that is not later.
            offset: added to every position in W [m], shape (3,).
        """
        k = min(max(int(np.searchsorted(self.times, since, side="right")) - 1, 0), len(self.times) - 2)
        return SampledTrajectory(self.times[k:] - self.times[k], self.p[k:] + offset, self.q[k:], self.v[k:], self.w[k:], self.a[k:],
                                 self.dw[k:], self.rotor_thrust[k:], self.start_time + float(self.times[k]))


def rest_to_rest(p0: Numbers, p1: Numbers, yaw0: float, yaw1: float, duration: float, start_time: float = 0.0) -> FlatTrajectory:
    """Straight move between two hovers: a polynomial of degree 9, whose derivatives 1-4 vanish at both ends.

    Args:
        p0, p1: end positions in W [m], shape (3,).
        yaw0, yaw1: end headings [rad]; the turn takes the shorter way.
        duration: [s], > 0.
        start_time: stamp of the start on the caller's clock [s].
    """
    turn = (yaw1 - yaw0 + np.pi) % (2.0 * np.pi) - np.pi
    first, last = np.array([*p0, yaw0], float), np.array([*p1, yaw0 + turn], float)
    coefficients = np.repeat(np.stack([first, last], axis=-1), 5, axis=-1)
    return FlatTrajectory(np.array([duration]), coefficients[None], start_time)
