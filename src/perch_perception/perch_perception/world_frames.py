"""Frames that do not move with the vehicle: what odometry may be expressed in."""

from __future__ import annotations

MAP, ODOM = "map", "odom"
_WORLD = frozenset((MAP, ODOM, "world", ""))


def is_world(frame: str) -> bool:
    """Whether a frame is one of `map`, `odom`, `world`, or not named."""
    return frame in _WORLD
