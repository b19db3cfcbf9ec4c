"""Figures with their uncertainty: Wilson intervals for rates, medians with ranges for errors.

`scipy.stats` has the interval, too, but loading it takes half a second in each process of a campaign.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri


@dataclass(frozen=True)
class Rate:
    """Successes out of trials with the Wilson score interval of 95 %."""

    successes: int
    trials: int

    @classmethod
    def from_outcomes(cls, outcomes: Iterable[bool]) -> Rate:
        """Return the rate of trials whose outcome is true."""
        found = list(outcomes)
        return cls(sum(found), len(found))

    @property
    def value(self) -> float:
        """Share of successes; nan without trials."""
        return self.successes / self.trials if self.trials else math.nan

    @property
    def interval(self) -> tuple[float, float]:
        """Wilson score interval, valid also at rates of 0 and 1; (0, 1) without trials."""
        if not self.trials:
            return 0.0, 1.0
        k, n, z = self.successes, self.trials, float(ndtri(0.975))
        middle, half = (k + 0.5 * z**2) / (n + z**2), z / (n + z**2) * math.sqrt(k * (n - k) / n + 0.25 * z**2)
        return max(0.0, middle - half), min(1.0, middle + half)

    def at_least(self, share: float) -> bool | None:
        """Return whether the rate is at least a share; None: it is not below it, but of so few trials that even all successes would not
        show it."""
        if self.interval[1] < share:
            return False
        return self.value >= share if Rate(self.trials, self.trials).interval[0] >= share else None

    def __str__(self) -> str:
        low, high = self.interval
        return f"{self.successes}/{self.trials} = {100 * self.value:.1f} % [{100 * low:.1f}, {100 * high:.1f}]"


@dataclass(frozen=True)
class Spread:
    """Median with range of the finite values."""

    median: float
    low: float
    high: float
    count: int

    @classmethod
    def from_values(cls, values: Iterable[float | None]) -> Spread:
        """Return the spread of values; those that are None or not finite are left out."""
        finite = [float(v) for v in values if v is not None and math.isfinite(v)]
        if not finite:
            return cls(math.nan, math.nan, math.nan, 0)
        return cls(float(np.median(finite)), min(finite), max(finite), len(finite))

    def to_text(self, scale: float = 1.0, digits: int = 1, unit: str = "") -> str:
        """`1.2 [0.8, 2.0] cm`, or a dash without values."""
        if not self.count:
            return "-"
        tail = f" {unit}" if unit else ""
        return f"{scale * self.median:.{digits}f} [{scale * self.low:.{digits}f}, {scale * self.high:.{digits}f}]{tail}"
