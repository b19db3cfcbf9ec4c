"""A cable hanging between two points: the catenary, and its approximation by straight segments. [P:sec. IV-A]

In the plane of the cable, x along the horizontal and z against gravity, z(x) = a cosh((x - x0)/a) + const with the
parameter a = H/w: horizontal tension over weight per length. Arc length and its inverse have closed forms.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from perch_core.arrays import Array
from perch_core.errors import PerchError


@dataclass(frozen=True, eq=False)
class Catenary:
    """A cable of constant weight per length between two supports.

    Attributes:
        start, end: supports in W [m], shape (3,).
        parameter: a = H/w [m]; inf: a straight cable.
    """

    start: Array
    end: Array
    parameter: float

    def __post_init__(self) -> None:
        for name in ("start", "end"):
            vector = np.array(getattr(self, name), dtype=float)
            if vector.shape != (3,) or not np.all(np.isfinite(vector)):
                raise PerchError(f"cable: {name} needs three finite numbers, got {getattr(self, name)!r}")
            object.__setattr__(self, name, vector)
        if not np.linalg.norm(self.end - self.start) > 0:
            raise PerchError(f"cable: both ends are at {self.start.tolist()} m")
        if not self.parameter > 0:
            raise PerchError(f"cable: parameter {self.parameter!r} is not > 0 m")
        if math.isfinite(self.parameter) and not self._span > 1e-6:
            raise PerchError("cable: the ends are one above the other, so that it hangs straight: parameter must be inf")
        if math.isfinite(self.parameter) and self._span / self.parameter > 100.0:
            raise PerchError(f"cable: parameter {self.parameter:g} m is too small for a span of {self._span:g} m")

    @classmethod
    def from_sag(cls, start: Array, end: Array, sag: float) -> Catenary:
        """Return the cable that hangs `sag` [m] below the chord at mid-span.

        Raises:
            PerchError: the sag is negative or too large for the span, or one end is vertically above the other.
        """
        if not (math.isfinite(sag) and sag >= 0):
            raise PerchError(f"cable: sag {sag!r} is not a length >= 0 m")
        straight = cls(start, end, math.inf)
        if sag < 1e-9:
            return straight
        span = straight._span
        if not span > 1e-6:
            raise PerchError(f"cable: a sag of {sag:g} m needs ends that are not one above the other")
        largest = cls(start, end, span / 60.0).sag
        if sag > largest:
            raise PerchError(f"cable: sag {sag:g} m is outside [0, {largest:g}] m for a span of {span:g} m")
        from scipy.optimize import brentq  # 0.2 s of the start of a node that hangs no cable

        log_a = brentq(lambda x: math.log(cls(start, end, math.exp(x)).sag / sag),
                       math.log(span / 60.0), math.log(span * straight.length / sag + span) + 2.0, xtol=1e-14)
        return cls(start, end, math.exp(log_a))

    @property
    def _rise(self) -> float:
        return float(self.end[2] - self.start[2])

    @property
    def _across(self) -> Array:
        """From start to end along the horizontal [m], shape (3,)."""
        x, y, _ = self.end - self.start
        return np.array([x, y, 0.0])

    @cached_property
    def _span(self) -> float:
        return float(np.linalg.norm(self._across))

    @cached_property
    def _x0(self) -> float:
        """Horizontal distance of the lowest point from the start [m]; the point may lie outside the span."""
        a, h = self.parameter, self._span
        return h / 2 - a * math.asinh(self._rise / (2 * a * math.sinh(h / (2 * a))))

    @property
    def straight(self) -> bool:
        """Whether the cable has no sag at all."""
        return math.isinf(self.parameter)

    @property
    def sag(self) -> float:
        """Drop below the chord at mid-span [m]."""
        if self.straight:
            return 0.0
        a, h = self.parameter, self._span
        return a * math.cosh((h / 2 - self._x0) / a) * 2 * math.sinh(h / (4 * a)) ** 2

    @cached_property
    def length(self) -> float:
        """Length of the cable [m]."""
        if self.straight:
            return float(np.linalg.norm(self.end - self.start))
        return math.hypot(self._rise, 2 * self.parameter * math.sinh(self._span / (2 * self.parameter)))

    def _at(self, x: Array) -> Array:
        """Points in W at distances x along the horizontal, (...) -> (..., 3)."""
        a, x0 = self.parameter, self._x0
        # cosh(p) - cosh(q) as a product: a is often a thousand times the sag
        z = 2 * a * np.sinh((x - 2 * x0) / (2 * a)) * np.sinh(x / (2 * a))
        points: Array = self.start + x[..., None] * (self._across / self._span) + z[..., None] * np.array([0.0, 0.0, 1.0])
        return points

    def _x_of(self, s: Array) -> Array:
        a, x0 = self.parameter, self._x0
        return x0 + a * np.arcsinh(s / a - math.sinh(x0 / a))

    def point(self, s: Array | float) -> Array:
        """Points in W [m] at arc lengths s from the start [m]: shape (...) -> (..., 3)."""
        s = np.asarray(s, dtype=float)
        if self.straight:
            return self.start + (s / self.length)[..., None] * (self.end - self.start)
        return self._at(self._x_of(s))

    def sample(self, count: int) -> Array:
        """`count` points in W from start to end, evenly spread along the cable [m], shape (count, 3)."""
        return self.point(np.linspace(0.0, self.length, count))

    def pieces(self, max_error: float) -> int:
        """Number of equally long pieces whose chords are within `max_error` [m] of the cable.

        The sagitta of a piece of the length h is at most h^2 / 8 times the greatest curvature, 1/a at the lowest point.
        """
        return max(1, math.ceil(self.length / math.sqrt(8 * self.parameter * max_error)))


@dataclass(frozen=True, eq=False)
class SegmentFit:
    """Approximation of a cable by straight segments.

    Attributes:
        vertices: ends of the segments in W [m], shape (count + 1, 3), on the cable.
        max_error: greatest distance between cable and segments [m].
        mean_error: mean distance along the segments [m].
    """

    vertices: Array
    max_error: float
    mean_error: float


def fit_segments(cable: Catenary, count: int) -> SegmentFit:
    """Approximate a cable by `count` chords with equal errors.

    The sagitta of a short chord is curvature * length^2 / 8, and a catenary's curvature is a/(a^2 + s^2) at the
    arc length s from the lowest point; the integral of its root is x/sqrt(a). Vertices that are evenly
    spaced along the *horizontal* spread the error evenly. Both errors are exact, not sampled.

    Raises:
        PerchError: the count is below 1.
    """
    if count < 1:
        raise PerchError(f"cable: {count!r} segments are not >= 1")
    if cable.straight:
        return SegmentFit(cable.sample(count + 1), 0.0, 0.0)
    a, x0 = cable.parameter, cable._x0
    x = np.linspace(0.0, cable._span, count + 1)
    vertices = cable._at(x)
    half = (x[1] - x[0]) / 2
    middle = (x[:-1] + x[1:]) / 2 - x0
    ratio = math.sinh(half / a) * a / half
    slope = np.sinh(middle / a) * ratio  # of each chord
    length = 2 * half * np.sqrt(1 + slope**2)
    # the gap below a chord is greatest where the cable runs parallel to it; gaps are measured against the
    # middle's height a cosh(middle/a), to keep their digits
    parallel = a * np.arcsinh(slope) - middle
    chord_height = 2 * a * np.cosh(middle / a) * math.sinh(half / (2 * a)) ** 2 + slope * parallel
    cable_height = 2 * a * np.sinh((2 * middle + parallel) / (2 * a)) * np.sinh(parallel / (2 * a))
    gap = (chord_height - cable_height) / np.sqrt(1 + slope**2)
    # area between chord and cable: half * (sum of end heights) - a^2 (sinh(right/a) - sinh(left/a))
    q = half / a
    area = 2 * a**2 * np.cosh(middle / a) * (q * math.cosh(q) - math.sinh(q))
    return SegmentFit(vertices, float(gap.max()), float(area.sum() / length.sum()))
