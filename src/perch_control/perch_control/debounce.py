"""Debounce: a condition must hold for some time before it takes effect."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass
class Debounce:
    """Debounced condition: `update` returns True once the condition has held for `hold` seconds."""

    hold: float
    since: float | None = None

    def update(self, condition: bool, now: float) -> bool:
        """Take the condition at a time [s]; return whether it has held for `hold` seconds."""
        if not condition:
            self.since = None
            return False
        if self.since is None:
            self.since = now
        return now - self.since >= self.hold
