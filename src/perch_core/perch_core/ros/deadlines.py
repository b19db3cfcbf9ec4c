"""Missed deadlines of a node that answers every step in real time."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterable

WINDOW = 500  # answers from which the clocks' offset and the figures are taken
NEVER = 1 << 62
# After so many late answers in a row, stamps have lost time to the wall clock: a vehicle catches up 25 steps at most.
LATE_IN_A_ROW_MAX = 50


def median_and_p99(samples: Iterable[float]) -> tuple[float, float]:
    """Median and 99th percentile of at least one sample. numpy takes ten times as long: half a control period for 500 samples."""
    ordered = sorted(samples)
    return ordered[(len(ordered) - 1) // 2], ordered[int(0.99 * (len(ordered) - 1))]


def durations_us(name: str, seconds: Collection[float]) -> dict[str, float]:
    """Median and 99th percentile of durations [s] for /diagnostics, in microseconds; empty without durations."""
    if not seconds:
        return {}
    median, p99 = median_and_p99(seconds)
    return {f"{name}_us_median": 1e6 * median, f"{name}_us_p99": 1e6 * p99}


class Deadlines:
    """Counts answers that left too late by the wall clock, and steps that were never answered.

    In real time stamps advance with the wall clock, so `clock - stamp` is the same for every answer except for delays. Its
    least value over the last `WINDOW` answers belongs to an undelayed answer. A deadline is *missed* when an answer leaves more
    than one period later than that: its successor was due by then. Delays count whether caused by the vehicle, the node or
    the operating system. The period is that of the stamps, whatever the IMU's rate. Where the vehicle skips time that it
    cannot catch up, the stamps stay behind the wall clock: `LATE_IN_A_ROW_MAX` late answers in a row count as missed, then their
    least offset is taken as undelayed. In simulated time there are no deadlines, and this class is not used.
    """

    def __init__(self) -> None:
        self.answers = 0
        self.missed = 0
        self._last_stamp: int | None = None
        self._period = self._window_period = NEVER  # least interval of stamps, as `_least`
        self._least = self._window_least = self._window_count = 0  # least offset of the last and the current window; its length
        self._late_in_a_row = self._late_least = 0  # late answers in a row and their least offset
        self._lateness: deque[int] = deque(maxlen=WINDOW)

    def record_answer(self, stamp: int, now: int) -> None:
        """Record an answer that has been sent.

        Args:
            stamp: stamp of the answered step [ns].
            now: time of a monotonic clock [ns].
        """
        offset, last = now - stamp, self._last_stamp
        self._last_stamp = stamp
        if self._window_count == 0:
            self._least, self._window_least = (offset if last is None else self._window_least), offset
            self._period, self._window_period = self._window_period, NEVER
        self._window_count = (self._window_count + 1) % WINDOW
        if offset < self._window_least:
            self._window_least = offset
        interval = 0 if last is None else stamp - last
        if 0 < interval < self._window_period:
            self._window_period = interval
        period = min(self._period, self._window_period)
        lateness = offset - min(self._least, self._window_least)
        self._lateness.append(lateness)
        self.answers += 1
        if 2 * interval >= 3 * period:
            skipped = round(interval / period) - 1
            self.answers += skipped
            self.missed += skipped
        if lateness <= period:
            self._late_in_a_row = 0
            return
        self.missed += 1
        self._late_in_a_row += 1
        self._late_least = offset if self._late_in_a_row == 1 else min(self._late_least, offset)
        if self._late_in_a_row == LATE_IN_A_ROW_MAX:
            self._least = self._window_least = self._late_least

    def report(self) -> dict[str, int | float]:
        """Figures for /diagnostics: counts since the start, and the delay of the last `WINDOW` answers."""
        values: dict[str, int | float] = {"deadlines": self.answers, "missed_deadlines": self.missed}
        if self._lateness:
            values["delay_us_p99"] = 1e-3 * median_and_p99(self._lateness)[1]
        return values
