"""The period of a stream, measured from its stamps."""

from __future__ import annotations

NOMINAL_PERIOD = 0.002  # of odometry and IMU, until another one is measured [s]
_SAMPLES = 25           # differences of which the median is taken
_TOLERANCE = 0.1        # a median that differs by less is the same period
_PERIOD_MIN, _PERIOD_MAX = 0.0005, 0.05


class MeasuredPeriod:
    """Period of a stream of samples: the nominal one until the median of 25 differences deviates by more than a tenth.

    Attributes:
        value: the period [s].
    """

    def __init__(self) -> None:
        self.value = NOMINAL_PERIOD
        self._last: float | None = None
        self._differences: list[float] = []

    def update(self, time: float) -> bool:
        """Take the stamp of a sample [s]; returns whether `value` has changed."""
        last, self._last = self._last, time
        if last is None or time <= last:
            return False
        self._differences.append(time - last)
        if len(self._differences) < _SAMPLES:
            return False
        median = sorted(self._differences)[_SAMPLES // 2]
        self._differences.clear()
        if abs(median - self.value) <= _TOLERANCE * self.value or not _PERIOD_MIN <= median <= _PERIOD_MAX:
            return False
        self.value = median
        return True
