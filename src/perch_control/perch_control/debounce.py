"""Conditions that must hold for a while before anything acts on them."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass
class Debounce:
    """A condition with memory: `update` is true from `hold` seconds of it on."""

    hold: float
    since: float | None = None

    def update(self, condition: bool, now: float) -> bool:
        """Take the condition at a time [s]."""
        if not condition:
            self.since = None
            return False
        if self.since is None:
            self.since = now
        return now - self.since >= self.hold
