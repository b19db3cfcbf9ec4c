"""Times as the messages carry them: whole nanoseconds, read as seconds in the same way as from a header."""

from __future__ import annotations

SECOND = 1_000_000_000


def seconds(stamp: int) -> float:
    """A stamp [ns] in seconds, to the last bit as a node reads it from a header."""
    return stamp // SECOND + 1e-9 * (stamp % SECOND)


def stamp_of(time: float) -> int:
    """The stamp [ns] that a time [s] is published with."""
    return round(time * SECOND)


def published(time: float) -> float:
    """A time [s] after its way through a header."""
    return seconds(stamp_of(time))
