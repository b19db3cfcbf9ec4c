"""Rate curve of the firmware and its inverse. Without numpy, so that the link's process starts quickly and stays small."""

from __future__ import annotations

from dataclasses import dataclass

CENTRE, HALF = 1500, 500  # pulse widths [us]


@dataclass(frozen=True)
class RateCurve:
    """Betaflight's rate curve of type ACTUAL.

        rate(s) = c s + (m - c) |s| (e s^5 + (1 - e) s),   s in [-1, 1]

    Attributes:
        centre: c, slope at the centre of the stick [deg/s].
        maximum: m >= c, rate at the end of the stick [deg/s].
        expo: e, 0..1.
    """

    centre: float
    maximum: float
    expo: float

    def rate(self, stick: float) -> float:
        """Return the angular velocity [deg/s] at a stick deflection in [-1, 1]."""
        return self.centre * stick + (self.maximum - self.centre) * abs(stick) * (self.expo * stick**5 + (1 - self.expo) * stick)

    def stick(self, rate: float) -> float:
        """Return the stick deflection that commands a rate [deg/s], in [-1, 1]. By bisection, as the curve is monotonic."""
        if rate == 0.0:
            return 0.0
        if abs(rate) >= self.rate(1.0):
            return 1.0 if rate > 0 else -1.0
        low, high = 0.0, 1.0
        for _ in range(14):  # finer than a microsecond of the pulse
            middle = 0.5 * (low + high)
            low, high = (middle, high) if self.rate(middle) < abs(rate) else (low, middle)
        return 0.5 * (low + high) if rate > 0 else -0.5 * (low + high)
