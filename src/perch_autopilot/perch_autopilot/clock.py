"""Detection of jumps of the host's clock by a component that is woken at a short period."""

from __future__ import annotations

from perch_core.values import NANOSECONDS, seconds

MAX_STEP = NANOSECONDS  # longest time between two wakes of a node that keeps up [ns]


def clock_jump(before: int | None, now: int) -> str:
    """Describe a jump of the host's clock between the times of two wakes [ns]; empty if there is none, or no earlier wake."""
    if before is None or 0 <= now - before < MAX_STEP:
        return ""
    way, else_ = ("back", "") if now < before else ("on", ", or this node was suspended")
    return f"the clock went {way} by {abs(seconds(now - before)):.3f} s at once: it was set{else_}"
