"""What processes and threads ask of the operating system."""

from __future__ import annotations

import ctypes
import gc
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress

_PR_SET_PDEATHSIG = 1


def end_with_parent(signal_number: int) -> None:
    """Have the operating system send this process a signal when the one that started it ends, however it ends (Linux)."""
    with suppress(OSError, AttributeError):  # elsewhere a process ends with its pipes
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, int(signal_number))


def give_way(task: int, nice: int) -> None:
    """Let others go before a thread (0: the caller): less of the processor, and none that another is using when it wakes up (Linux)."""
    os.setpriority(os.PRIO_PROCESS, task, nice)
    with suppress(OSError, AttributeError):
        os.sched_setscheduler(task, os.SCHED_BATCH, os.sched_param(0))


def freeze_heap() -> None:
    """Keep what is there now out of the garbage collector's sight: looking through it again takes up to 0.1 s, at any moment."""
    gc.collect()
    gc.freeze()


@contextmanager
def frozen_heap() -> Iterator[None]:
    """`freeze_heap` for as long as it takes."""
    freeze_heap()
    try:
        yield
    finally:
        gc.unfreeze()
