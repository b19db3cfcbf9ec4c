"""A host's clock that jumps, seen by who is woken at a short period."""

from __future__ import annotations

from perch_core.values import NANOSECONDS, seconds

JUMP = NANOSECONDS  # time does not go on by more between two wakes of a node that keeps up [ns]


def jumped(before: int | None, now: int) -> str:
    """What is wrong with a host's time [ns] after another; empty: nothing, or there was none before."""
    if before is None or 0 <= now - before < JUMP:
        return ""
    way, else_ = ("back", "") if now < before else ("on", ", or this node has stood still")
    return f"the clock went {way} by {abs(seconds(now - before)):.3f} s at once: it was set{else_}"
