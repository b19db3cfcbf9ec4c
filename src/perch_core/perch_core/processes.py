"""Processes that belong to another."""

from __future__ import annotations

import ctypes
from contextlib import suppress

_PR_SET_PDEATHSIG = 1


def end_with_parent(signal_number: int) -> None:
    """Have the operating system send this process a signal when the one that started it ends, however it ends (Linux)."""
    with suppress(OSError, AttributeError):  # elsewhere a process ends with its pipes
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, int(signal_number))
