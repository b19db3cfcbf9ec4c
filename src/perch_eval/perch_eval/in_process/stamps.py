"""Times as the messages carry them: whole nanoseconds, read as seconds in the same way as from a header."""

from __future__ import annotations

from perch_core.ros.conversions import NANOSECONDS as SECOND
from perch_core.ros.conversions import seconds

__all__ = ["SECOND", "published", "seconds", "stamp_of"]


def stamp_of(time: float) -> int:
    """The stamp [ns] that a time [s] is published with."""
    return round(time * SECOND)


def published(time: float) -> float:
    """A time [s] after its way through a header."""
    return seconds(stamp_of(time))
