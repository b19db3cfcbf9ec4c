"""Fixed frames, in which odometry may be expressed."""

from __future__ import annotations

MAP, ODOM = "map", "odom"
_WORLD = frozenset((MAP, ODOM, "world", ""))


def is_world(frame: str) -> bool:
    """Whether a frame is `map`, `odom`, `world` or unnamed."""
    return frame in _WORLD
