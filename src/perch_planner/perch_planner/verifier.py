"""An independent check of a perching plan, from its published coefficients alone.

No code of the planner is used: the trajectory is rebuilt as power series in exact rationals from the
coefficients of the message. Attitude and body rate are sampled densely, by finite differences of rotations. Extrema are taken
from the roots of derivatives (numpy's eigenvalue method), whereas the planner subdivides Bernstein coefficients.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from math import comb
from typing import Any, Protocol

import numpy as np
from numpy.polynomial import chebyshev
from numpy.polynomial import polynomial as power

from perch_core.arrays import Array, Numbers

_G = 9.81
_TOLERANCE = 1e-9  # of the end conditions, relative to 1 + their size
_PLATE_TOLERANCE = 1e-4  # of the plate's distance from the surface [m]
_TURN = 1e-4  # [s] between the rotations from which rates and accelerations are taken


@dataclass(frozen=True)
class Rotors:
    """Requirements on the single rotors.

    Attributes:
        inertia: principal moments [kg m^2], shape (3,).
        allocation: rotor thrusts to collective thrust and moments, shape (4, 4).
        thrust: least and greatest of each rotor [N].
    """

    inertia: Array
    allocation: Array
    thrust: tuple[float, float]


@dataclass(frozen=True)
class Requirements:
    """Requirements on a plan, in plain numbers.

    Attributes:
        start: position, velocity, acceleration, jerk at time 0, shape (4, 3).
        start_yaw: yaw and its rate at time 0.
        end_yaw: heading at contact, at rest, modulo a full turn [rad].
        waypoints: position, velocity, acceleration, jerk at each waypoint, shape (k, 4, 3); nan where free.
        p_S, s3, v_S: point of the surface at time 0 [m], outward normal, velocity [m/s], shape (3,).
        s1, s2: directions in the surface, shape (3,).
        perch_offset: distance of the velcro plate below the centre of mass, and of the latter from the surface at contact [m].
        mass: [kg].
        impact_acceleration: alpha [m/s^2].
        impact_speed: least and greatest speed along -s3 [m/s].
        tangential_speed: greatest speed over the surface at contact [m/s].
        contact_delay: both speeds also hold for a contact delayed by this time [s] at constant acceleration, unless the change of
            the speed exceeds the width of its bounds.
        tube: t_k [s], dt [s], q, least half width [m/s^2].
        thrust: least and greatest [N].
        body_rate: greatest [rad/s].
        speed: greatest [m/s].
        height: least and greatest [m].
        extension: radius of the rim [m].
        duration: longest [s].
        clearance: least distance of the rim from the surface [m]; where it is negative, also that of the plate.
        rotors: limits of the single rotors, or None.
    """

    start: Array
    start_yaw: tuple[float, float]
    end_yaw: float
    waypoints: Array
    p_S: Array
    s1: Array
    s2: Array
    s3: Array
    v_S: Array
    perch_offset: float
    mass: float
    impact_acceleration: float
    impact_speed: tuple[float, float]
    tangential_speed: float
    contact_delay: float
    tube: tuple[float, float, float, float]
    thrust: tuple[float, float]
    body_rate: float
    speed: float
    height: tuple[float, float]
    extension: float
    duration: float
    clearance: float = 0.0
    rotors: Rotors | None = None


AtMost = Callable[[str, float, float, float, float], None]
Axes = tuple[Array, Array, Array]


class Equal(Protocol):
    """Records a finding where a value differs from the required one."""

    def __call__(self, name: str, value: Any, expected: Array, t: float, slack: float = 1.0) -> None: ...


@dataclass(frozen=True)
class Finding:
    """A violated requirement: its name, the excess, and the time [s]."""

    requirement: str
    excess: float
    time: float


def _powers(bernstein_row: Numbers) -> Array:
    """Coefficients of ascending powers of s, computed in exact integers over one power of two."""
    n = len(bernstein_row) - 1
    ratios = [float(c).as_integer_ratio() for c in bernstein_row]
    scale = max(denominator for _, denominator in ratios)
    exact = [numerator * (scale // denominator) for numerator, denominator in ratios]
    return np.array([float(Fraction(sum((-1) ** (k - i) * comb(n, k) * comb(k, i) * exact[i] for i in range(k + 1)), scale))
                     for k in range(n + 1)])


def _extrema(square: Callable[[Array], Array], degree: int) -> tuple[float, float]:
    """Smallest and largest value of a smooth function on [0, 1], from the roots of its Chebyshev interpolant's derivative."""
    nodes = 0.5 * (1.0 + np.cos(np.pi * (np.arange(degree + 1) + 0.5) / (degree + 1)))
    series = chebyshev.chebfit(2.0 * nodes - 1.0, square(nodes), degree)
    roots = chebyshev.chebroots(chebyshev.chebder(series))
    real = roots.real[(np.abs(roots.imag) < 1e-3) & (np.abs(roots.real) <= 1.0)]
    values = square(np.concatenate([[0.0, 1.0], 0.5 * (1.0 + real)]))
    return float(values.min()), float(values.max())


class _Segment:
    def __init__(self, duration: float, rows: Sequence[Numbers] | Array) -> None:
        self.duration = float(duration)
        self._tables = [np.array([_powers(row) for row in rows]).T]  # powers of the derivatives up to the fourth
        for order in range(1, 5):
            self._tables.append(power.polyder(self._tables[0], order))

    def at(self, s: Numbers, order: int, outputs: slice = slice(0, 4)) -> Array:
        """Derivatives of x, y, z, yaw, or of some of them, at s, shape (len(s), outputs)."""
        values: Array = power.polyval(np.asarray(s, float), self._tables[order][:, outputs]).T / self.duration**order
        return values

    def force(self, s: Array) -> Array:
        """a + g e3 at s, shape (len(s), 3)."""
        return self.at(s, 2, slice(0, 3)) + (0.0, 0.0, _G)

    def yaw(self, s: Array) -> Array:
        """Yaw at s, shape (len(s),)."""
        return self.at(s, 0, slice(3, 4))[:, 0]


def _length(v: Array) -> Array:
    """Lengths of vectors, shape (n, 3) -> (n, 1)."""
    lengths: Array = np.sqrt(v[:, 0] ** 2 + v[:, 1] ** 2 + v[:, 2] ** 2)
    return lengths[:, None]


def _rotations(f: Array, yaw: Array) -> tuple[Array, Array, Array]:
    """Body axes b1, b2, b3, each of shape (n, 3)."""
    b3 = f / _length(f)
    c, s = np.cos(yaw), np.sin(yaw)
    b1 = np.stack([c * b3[:, 2], s * b3[:, 2], -s * b3[:, 1] - c * b3[:, 0]], axis=1)  # (-s, c, 0) x b3
    b1 /= _length(b1)
    return b1, np.cross(b3, b1), b3


def _turn(before: Axes, after: Axes) -> Array:
    """Axis times sine of the angle of the rotation between two attitudes, in the body frame, shape (n, 3)."""
    def dot(i: int, k: int) -> Array:
        a, b = before[i], after[k]
        product: Array = a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2]
        return product

    return 0.5 * np.stack([dot(2, 1) - dot(1, 2), dot(0, 2) - dot(2, 0), dot(1, 0) - dot(0, 1)], axis=1)


def verify(durations: Numbers, segments: Any, need: Requirements, step: float = 1e-4) -> list[Finding]:
    """Check a plan against all requirements.

    Args:
        durations: segment durations [s].
        segments: Bernstein coefficients of x, y, z, yaw of each segment, shape (f, 4, n + 1).
        need: the requirements.
        step: sampling of the dense check [s].

    Returns:
        The violated requirements; empty for a valid plan.
    """
    found: list[Finding] = []
    pieces = [_Segment(d, rows) for d, rows in zip(durations, segments)]
    begins = np.concatenate([[0.0], np.cumsum([piece.duration for piece in pieces])])
    end = float(begins[-1])

    def equal(name: str, value: Any, expected: Array, t: float, slack: float = 1.0) -> None:
        excess = float(np.abs(np.asarray(value) - expected).max())
        if not excess <= _TOLERANCE * slack * (1.0 + float(np.abs(expected).max())):
            found.append(Finding(name, excess, t))

    def at_most(name: str, value: float, limit: float, t: float, slack: float) -> None:
        if not value <= limit + slack:
            found.append(Finding(name, value - limit, t))

    _check_knots(pieces, begins, need, equal)
    last = pieces[-1]
    equal("position at contact", last.at([1.0], 0)[0, :3], need.p_S + need.v_S * end + need.perch_offset * need.s3, end)
    contact = need.impact_acceleration * need.s3 - np.array([0.0, 0.0, _G])
    equal("acceleration at contact [M:eq11]", last.at([1.0], 2)[0, :3], contact, end, slack=10.0)
    yaw, yaw_rate = last.at([1.0], 0)[0, 3], last.at([1.0], 1)[0, 3]
    equal("heading at contact [M:eq12]", np.remainder(yaw - need.end_yaw + np.pi, 2.0 * np.pi), np.array(np.pi), end)
    equal("yaw rate at contact", yaw_rate, np.array(0.0), end, slack=10.0)
    at_most("duration", end, need.duration, end, 1e-9)
    _check_impact(last.at([1.0], 1)[0, :3] - need.v_S, need.contact_delay * contact, need, end, at_most)
    _check_tube(pieces, begins, need, contact, at_most)
    for piece, begin in zip(pieces, begins):
        _check_exact(piece, float(begin), need, at_most)
        _check_dense(piece, float(begin), need, step, at_most)
        if need.rotors is not None:
            _check_rotors(piece, float(begin), need, need.rotors, step, at_most)
    return found


def _check_knots(pieces: list[_Segment], begins: Array, need: Requirements, equal: Equal) -> None:
    for order, expected in enumerate(need.start):
        equal(f"start, derivative {order} [M:eq6]", pieces[0].at([0.0], order)[0, :3], expected, 0.0, slack=10.0**order)
    equal("start yaw", pieces[0].at([0.0], 0)[0, 3], np.array(need.start_yaw[0]), 0.0)
    equal("start yaw rate", pieces[0].at([0.0], 1)[0, 3], np.array(need.start_yaw[1]), 0.0, slack=10.0)
    for k in range(len(pieces) - 1):
        for order in range(5):
            left, right = pieces[k].at([1.0], order)[0], pieces[k + 1].at([0.0], order)[0]
            equal(f"continuity of derivative {order} [M:eq7]", left, right, float(begins[k + 1]), slack=30.0**order)
    for k, waypoint in enumerate(need.waypoints):
        for order, expected in enumerate(waypoint):
            if np.isfinite(expected).all():
                equal(f"waypoint {k}, derivative {order} [M:eq6]", pieces[k].at([1.0], order)[0, :3], expected, float(begins[k + 1]), slack=10.0**order)


def _check_impact(v: Array, velocity_change: Array, need: Requirements, end: float, at_most: AtMost) -> None:
    """Check speed and slip of a contact on time, and of one after `velocity_change` where the bounds permit both."""
    axes, (least, most) = np.array([-need.s3, need.s1, need.s2]), need.impact_speed
    on_time, change = axes @ v, axes @ velocity_change
    slide = float(np.hypot(*change[1:]))
    speeds, slips = [float(on_time[0])], [float(np.hypot(*on_time[1:]))]
    if abs(change[0]) < most - least:
        speeds.append(float(on_time[0] + change[0]))
    if slide < 2.0 * np.cos(np.pi / 8.0) * need.tangential_speed:  # octagons inside circles that are farther apart need not meet
        slips.append(float(np.hypot(*(on_time + change)[1:])))
    at_most("impact speed, least [M:eq14]", least, min(speeds), end, 1e-9)
    at_most("impact speed, greatest [M:eq14]", max(speeds), most, end, 1e-9)
    at_most("tangential speed", max(slips), need.tangential_speed, end, 1e-9)


def _check_tube(pieces: list[_Segment], begins: Array, need: Requirements, contact: Array, at_most: AtMost) -> None:
    length, step, q, floor = need.tube
    half = np.maximum(np.abs(q * contact), floor)
    for j in range(int(np.ceil(length / step - 1e-9))):
        t = float(begins[-1]) - length + j * step
        if t < 0.0:
            continue
        k = min(int(np.searchsorted(begins, t, side="right")) - 1, len(pieces) - 1)
        a = pieces[k].at([min((t - begins[k]) / pieces[k].duration, 1.0)], 2)[0, :3]
        at_most("tube [M:eq15]", float((np.abs(a - contact) - half).max()), 0.0, t, 1e-8)


def _check_exact(piece: _Segment, begin: float, need: Requirements, at_most: AtMost) -> None:
    """Check the extrema of polynomials, computed from roots."""
    low, high = _extrema(lambda s: np.linalg.norm(piece.force(s), axis=1) ** 2, 26)
    at_most("thrust, greatest [M:eq16]", need.mass * max(high, 0.0) ** 0.5, need.thrust[1], begin, 1e-9)
    at_most("thrust, least [M:eq16]", need.thrust[0], need.mass * max(low, 0.0) ** 0.5, begin, 1e-9)
    _, high = _extrema(lambda s: np.linalg.norm(piece.at(s, 1)[:, :3], axis=1) ** 2, 28)
    at_most("speed", max(high, 0.0) ** 0.5, need.speed, begin, 1e-9)
    low, high = _extrema(lambda s: piece.at(s, 0)[:, 2], 16)
    at_most("height, least", need.height[0], low, begin, 1e-9)
    at_most("height, greatest", high, need.height[1], begin, 1e-9)


def _check_dense(piece: _Segment, begin: float, need: Requirements, step: float, at_most: AtMost) -> None:
    """Check body rate, clearance and plate on samples; the body rate from rotations half a step apart."""
    count = max(int(np.ceil(piece.duration / step)), 2)
    s = (np.arange(count) + 0.5) / count
    h = 0.25 / count
    before, after = (_rotations(piece.force(at), piece.yaw(at)) for at in (s - h, s + h))
    rate = np.arcsin(np.clip(_length(_turn(before, after))[:, 0], 0.0, 1.0)) / (2.0 * h * piece.duration)
    worst = int(rate.argmax())
    at_most("body rate [M:eq13]", float(rate[worst]), need.body_rate, begin + s[worst] * piece.duration, 1e-4 * need.body_rate)
    f = piece.force(s)
    b3 = f / _length(f)
    times = begin + s * piece.duration
    distance = (piece.at(s, 0, slice(0, 3)) - need.p_S - times[:, None] * need.v_S) @ need.s3
    for name, least, reach, slack in (
            ("clearance", need.clearance, need.extension * _length(np.cross(b3, need.s3))[:, 0], 1e-9),
            ("plate in front of the surface", min(need.clearance, 0.0), need.perch_offset * (b3 @ need.s3), _PLATE_TOLERANCE)):
        worst = int((distance - reach).argmin())
        at_most(name, least, float(distance[worst] - reach[worst]), float(times[worst]), slack)


def _turn_rates(before: Axes, after: Axes, step: float) -> Array:
    """Body rates between rotations `step` seconds apart, shape (n, 3)."""
    sine = _turn(before, after)
    size = _length(sine)
    return sine * np.where(size < 1e-9, 1.0, np.arcsin(np.clip(size, 0.0, 1.0)) / np.maximum(size, 1e-300)) / step


def _check_rotors(piece: _Segment, begin: float, need: Requirements, rotors: Rotors, step: float, at_most: AtMost) -> None:
    """Check rotor thrusts on samples: Euler's equation with rates and accelerations from three rotations `_TURN` apart."""
    h = _TURN / piece.duration
    count = max(int(np.ceil(piece.duration / step)), 2)
    s = h + (np.arange(count) + 0.5) / count * (1.0 - 2.0 * h)
    force = [piece.force(s + k * h) for k in (-1.0, 0.0, 1.0)]
    R = [_rotations(f, piece.yaw(s + k * h)) for f, k in zip(force, (-1.0, 0.0, 1.0))]
    first, second = _turn_rates(R[0], R[1], _TURN), _turn_rates(R[1], R[2], _TURN)
    rate, acceleration = 0.5 * (first + second), (second - first) / _TURN
    moment = rotors.inertia * acceleration + np.cross(rate, rotors.inertia * rate)
    collective = need.mass * np.linalg.norm(force[1], axis=1, keepdims=True)
    thrust = np.linalg.solve(rotors.allocation, np.hstack([collective, moment]).T)
    low, high = thrust.min(axis=0), thrust.max(axis=0)
    least, most = int(low.argmin()), int(high.argmax())
    at_most("rotor thrust, least [P:eq2]", rotors.thrust[0], float(low[least]), begin + s[least] * piece.duration, 1e-4)
    at_most("rotor thrust, greatest [P:eq2]", float(high[most]), rotors.thrust[1], begin + s[most] * piece.duration, 1e-4)
