"""Stamps in whole nanoseconds, and their conversion to seconds, which is the same to the last bit everywhere."""

from __future__ import annotations

from typing import overload

import numpy as np

NANOSECONDS = 1_000_000_000
STALE = NANOSECONDS  # age at which a command or a status is no longer current [ns]


@overload
def seconds(stamp: int) -> float: ...
@overload
def seconds(stamp: np.ndarray) -> np.ndarray: ...
def seconds(stamp: int | np.ndarray) -> float | np.ndarray:
    """Convert nanoseconds to seconds."""
    return stamp // NANOSECONDS + 1e-9 * (stamp % NANOSECONDS)


def nanoseconds(time: float) -> int:
    """Convert seconds to whole nanoseconds."""
    return round(time * NANOSECONDS)
