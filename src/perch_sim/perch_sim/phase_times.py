"""Where a second of wall-clock time went, and how fast simulation time passes."""

from __future__ import annotations

import time


class PhaseTimes:
    """Adds up wall-clock time by phase between two reports."""

    def __init__(self) -> None:
        self._since = self._mark = time.perf_counter()
        self._sums: dict[str, float] = {}
        self._steps = 0

    def end(self, phase: str) -> None:
        """The time since the last call was spent on `phase`."""
        now = time.perf_counter()
        self._sums[phase] = self._sums.get(phase, 0.0) + now - self._mark
        self._mark = now

    def count_step(self) -> None:
        """A control period has passed."""
        self._steps += 1

    def report(self, period: float) -> dict[str, float]:
        """Real-time factor, steps per second and share of each phase since the last report.

        Args:
            period: simulation time of a step [s].
        """
        now = time.perf_counter()
        span = max(now - self._since, 1e-9)
        values = {"real_time_factor": self._steps * period / span, "steps_per_s": self._steps / span}
        values.update({f"{name}_share": total / span for name, total in self._sums.items()})
        self._since, self._sums, self._steps = now, {}, 0
        return values
