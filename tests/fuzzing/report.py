"""How a hunt goes: time, counts, and the inputs that were found, kept as regression cases."""

from __future__ import annotations

import hashlib
import sys
import time
from collections import Counter
from pathlib import Path
from typing import TextIO


class Report:
    """Given to a hunt; it asks `going` before each input, and tells the outcome of each.

    Attributes:
        problems: what was found, first line of each.
    """

    def __init__(self, kind: str, minutes: float, cases: Path, out: TextIO | None = None, period: float = 10.0) -> None:
        """
        Args:
            kind: of inputs; found ones are kept in `cases/<kind>`.
            minutes: of the wall clock.
            cases: folder.
            out: where progress is shown.
            period: between lines where that is no terminal [s].
        """
        self.problems: list[str] = []
        self._folder, self._out, self._period = cases / kind, out or sys.stderr, period
        self._counts: Counter[str] = Counter()
        self._minutes = minutes
        self.begin()

    def begin(self) -> None:
        """Time counts from now on: what a hunt needs has been prepared."""
        self._began = self._shown = time.monotonic()
        self._end = self._began + 60.0 * self._minutes

    def going(self) -> bool:
        """Whether there is time for another input."""
        return time.monotonic() < self._end

    def tried(self, outcome: str, count: int = 1) -> None:
        """One more input, or some, had an outcome that makes sense (`refused`)."""
        self._counts[outcome] += count
        now = time.monotonic()
        if now - self._shown >= (0.2 if self._out.isatty() else self._period):
            self._shown = now
            print(f"\r\x1b[2K{self.line()}" if self._out.isatty() else self.line(), end="" if self._out.isatty() else "\n", file=self._out, flush=True)

    def found(self, name: str, content: bytes, problem: str) -> None:
        """An input had an outcome that makes none: it is kept, once per kind of problem."""
        first = problem.strip().splitlines()[-1]
        self._counts["found"] += 1
        if first in self.problems:
            return
        self.problems.append(first)
        stem, dot, suffix = name.rpartition(".")
        file = self._folder / f"{stem or name}-{hashlib.sha256(content).hexdigest()[:8]}{dot}{suffix if dot else ''}"
        self._folder.mkdir(parents=True, exist_ok=True)
        file.write_bytes(content)
        print(f"\n{file}\n{problem}", file=self._out, flush=True)

    def line(self) -> str:
        """Counts so far."""
        elapsed = time.monotonic() - self._began
        total = sum(self._counts.values())
        counts = ", ".join(f"{count} {outcome}" for outcome, count in sorted(self._counts.items()))
        return f"  {elapsed / 60.0:.1f} of {(self._end - self._began) / 60.0:.1f} min: {total} inputs ({total / max(elapsed, 1e-9):.0f} per second): {counts}"
