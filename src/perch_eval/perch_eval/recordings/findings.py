"""Findings of a check: what would make perception fail, with the underlying figures."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

OK, WARNING, FAILS = "ok", "warning", "fails"
RATE_MAX = 10_000.0  # rate of a sensor [Hz]
RATE_TOLERANCE = 0.01  # share by which a rate may lie below a bound: clocks differ


@dataclass(frozen=True)
class Finding:
    """One line of the check: `ok`, `warning` or `fails`, what it is about, and what was found."""

    level: str
    about: str
    text: str


@dataclass
class Report:
    """All findings, and the figures behind them."""

    findings: list[Finding] = field(default_factory=list)
    figures: dict[str, Any] = field(default_factory=dict)

    def add(self, about: str, text: str, warning: bool = False, fails: bool = False) -> None:
        """Add a finding."""
        self.findings.append(Finding(FAILS if fails else WARNING if warning else OK, about, text))

    @property
    def fails(self) -> bool:
        """Whether something would make perception fail."""
        return any(finding.level == FAILS for finding in self.findings)


def check_rate(report: Report, about: str, stamps: np.ndarray, minimum: float, recommended: float, nominal: float | None) -> float:
    """Check rate, jitter (1 sigma of an interval, in periods) and gaps of ascending stamps (three or more); return rate [Hz]."""
    intervals = 1e-9 * np.diff(stamps)
    reach = min(9, len(intervals))  # stamps may come in batches
    period = float(np.median(stamps[reach:] - stamps[:-reach])) * 1e-9 / reach
    rate, beside = 1.0 / period, np.pad(intervals, 1, constant_values=period)
    gap = (intervals > 1.8 * period) & (beside[:-2] + intervals + beside[2:] > 3.5 * period)
    jitter, gaps = float(intervals[~gap].std() / period) if not gap.all() else np.nan, intervals[gap]
    report.figures[f"{about} rate_hz"] = rate
    slow = rate < (1.0 - RATE_TOLERANCE) * recommended
    wrong = nominal is not None and not 0.8 < rate / nominal < 1.25
    report.add(f"{about} rate",
               f"{rate:.1f} Hz over {1e-9 * (stamps[-1] - stamps[0]):.1f} s" + (f", {nominal:g} Hz in the sensor file" if wrong else "") +
               (f": at least {recommended:g} Hz are recommended" if slow else "") +
               (": stamps are not in nanoseconds" if rate > RATE_MAX else ""),
               warning=slow or wrong, fails=not (1.0 - RATE_TOLERANCE) * minimum <= rate <= RATE_MAX)
    report.add(f"{about} jitter",
               f"{1e3 * jitter * period:.2f} ms (1 sigma), {100 * jitter:.0f} % of the period" +
               (": stamps are taken on arrival, or in batches; stamp where the sensor is sampled" if jitter > 0.1 else ""),
               warning=jitter > 0.1)
    if len(gaps):
        lost = round(float((gaps / period - 1.0).sum()))
        share = 100 * lost / (len(stamps) + lost)
        report.add(f"{about} gaps", f"{len(gaps)}, the longest {1e3 * gaps.max():.0f} ms; {lost} missing ({share:.1f} %)", warning=True)
    return rate
