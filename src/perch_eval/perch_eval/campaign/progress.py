"""Progress of a campaign and estimate of the remaining time."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from typing import Any, TextIO, TypeVar

T = TypeVar("T")


class Progress:
    """Progress line, rewritten in place on a terminal; elsewhere one line per period. Without a total it shows the count only."""

    def __init__(self, total: int | None, already: int = 0, good_already: int = 0, what: str = "runs", out: TextIO | None = None,
                 period: float = 10.0) -> None:
        self._total, self._done, self._good, self._already = total, already, good_already, already
        self._what, self._out, self._judged = what, out or sys.stderr, already > 0
        self._terminal = self._out.isatty()
        self._period = 0.1 if self._terminal else period
        self._began = self._shown = time.monotonic()

    def add(self, good: bool | None = None) -> None:
        """Count one more as finished; None: it is neither good nor bad."""
        self._done += 1
        self._good += bool(good)
        self._judged |= good is not None
        now = time.monotonic()
        if now - self._shown >= self._period or self._done == self._total:
            self._shown = now
            self._out.write(f"\r\x1b[2K{self.line(now)}" if self._terminal else f"{self.line(now)}\n")
            self._out.flush()

    def line(self, now: float) -> str:
        """Return the progress line at a time of the monotonic clock [s]."""
        fresh, elapsed = self._done - self._already, max(now - self._began, 1e-9)
        rate = fresh / elapsed
        text = f"  {self._done}" + ("" if self._total is None else f"/{self._total}") + f" {self._what}"
        if self._done and self._judged:
            text += f", {self._good} good ({100 * self._good / self._done:.0f} %)"
        if fresh:
            text += f", {60 * rate:.1f} per minute"
            if self._total is not None and self._done < self._total:
                text += f", {span((self._total - self._done) / rate)} left"
        return text

    def close(self) -> None:
        """End the line."""
        if self._terminal and self._done > self._already:
            self._out.write("\n")


def counted(found: Iterable[T], total: int, good: Callable[[T], bool | None] = lambda _: None, **options: Any) -> Iterator[T]:
    """Yield the items of `found` and count each in a progress line; further options are those of `Progress`."""
    with closing(Progress(total, **options)) as progress:
        for one in found:
            yield one
            progress.add(good(one))


def span(seconds: float) -> str:
    """Return a duration as text."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
