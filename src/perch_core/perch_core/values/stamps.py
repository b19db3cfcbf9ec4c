"""Stamps: whole nanoseconds, exact, and the same as seconds to the last bit wherever they are read."""

from __future__ import annotations

from typing import overload

import numpy as np

NANOSECONDS = 1_000_000_000


@overload
def seconds(stamp: int) -> float: ...
@overload
def seconds(stamp: np.ndarray) -> np.ndarray: ...
def seconds(stamp: int | np.ndarray) -> float | np.ndarray:
    """Nanoseconds in seconds."""
    return stamp // NANOSECONDS + 1e-9 * (stamp % NANOSECONDS)


def nanoseconds(time: float) -> int:
    """Seconds in whole nanoseconds."""
    return round(time * NANOSECONDS)
