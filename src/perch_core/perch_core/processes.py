"""What processes and threads ask of the operating system."""

from __future__ import annotations

import ctypes
import gc
import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from multiprocessing import resource_tracker

_PR_SET_PDEATHSIG = 1
_SET_THREADS = ("openblas_set_num_threads", "openblas_set_num_threads64_", "scipy_openblas_set_num_threads", "scipy_openblas_set_num_threads64_")
"""Names of one function in OpenBLAS as it comes with Linux, numpy and scipy."""


def end_with_parent(signal_number: int) -> None:
    """Have the operating system send this process a signal when the one that started it ends, however it ends (Linux)."""
    with suppress(OSError, AttributeError):  # elsewhere a process ends with its pipes
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, int(signal_number))


def end_within(seconds: int) -> None:
    """Have the operating system end this process by SIGALRM, unless it has ended by itself before."""
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.alarm(seconds)


@contextmanager
def without_interrupts() -> Iterator[None]:
    """Processes that are started meanwhile do not see Ctrl-C, which is this one's own matter, until they let it through."""
    resource_tracker.ensure_running()  # it lets SIGINT through as it starts
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def give_way(task: int, nice: int) -> None:
    """Let others go before a thread (0: the caller): less of the processor, and none that another is using when it wakes up (Linux)."""
    os.setpriority(os.PRIO_PROCESS, task, nice)
    with suppress(OSError, AttributeError):
        os.sched_setscheduler(task, os.SCHED_BATCH, os.sched_param(0))


def one_thread_for_sums() -> None:
    """Have BLAS add on one thread in this process, also where it is loaded already: other threads add in another order, which
    changes the last bits of a flight, and for small matrices they take longer."""
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = "1"  # of what is loaded later
    with suppress(OSError), open("/proc/self/maps") as file:
        for path in {line.split(maxsplit=5)[-1].strip() for line in file if "openblas" in line}:
            library = ctypes.CDLL(path)
            for function in _SET_THREADS:
                if hasattr(library, function):
                    getattr(library, function)(1)


@contextmanager
def without_collector() -> Iterator[None]:
    """Nothing is looked through for garbage meanwhile."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


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
