"""Settings of processes and threads: signals, output, priorities, BLAS threads and garbage collection."""

from __future__ import annotations

import ctypes
import gc
import os
import select
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from multiprocessing import resource_tracker

_PR_SET_PDEATHSIG = 1
_SET_THREADS = ("openblas_set_num_threads", "openblas_set_num_threads64_", "scipy_openblas_set_num_threads", "scipy_openblas_set_num_threads64_")
"""Names of the same OpenBLAS function in the builds of Linux, numpy and scipy."""


def end_with_parent(signal_number: int, parent: int | None = None) -> None:
    """Have the operating system send this process a signal when its parent ends, for whatever reason (Linux).

    Args:
        signal_number: the signal.
        parent: process id of the parent: the signal is sent now if it has already ended; None: this is not checked.
    """
    with suppress(OSError, AttributeError):  # elsewhere a process ends with its pipes
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, int(signal_number))
    if parent is not None and os.getppid() != parent:
        signal.raise_signal(signal_number)


def end_within(seconds: int) -> None:
    """Have the operating system end this process by SIGALRM after a time [s], unless it ends before."""
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.alarm(seconds)


@contextmanager
def without_interrupts() -> Iterator[None]:
    """Block SIGINT for processes started in this context until they unblock it: only this process handles Ctrl-C."""
    resource_tracker.ensure_running()  # it lets SIGINT through as it starts
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def discard_closed_output() -> bool:
    """Return whether the reader of standard output has ended (`... | head`); if so, discard what is left to print, for a quiet end."""
    closed = select.poll()
    closed.register(sys.stdout.fileno(), 0)
    if not closed.poll(0):
        return False
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return True


def lower_priority(task: int, nice: int) -> None:
    """Lower the priority of a thread (0: the caller): higher nice value, no preemption of other threads at wake-up (Linux)."""
    os.setpriority(os.PRIO_PROCESS, task, nice)
    with suppress(OSError, AttributeError):
        os.sched_setscheduler(task, os.SCHED_BATCH, os.sched_param(0))


def single_threaded_blas() -> None:
    """Restrict BLAS to one thread in this process, also where it is loaded already: several threads add in another order, which
    changes the last bits of a flight, and take longer for small matrices."""
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
    """Disable garbage collection in this context."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def freeze_heap() -> None:
    """Exclude all present objects from garbage collection: scanning them again takes up to 0.1 s, at any moment."""
    gc.collect()
    gc.freeze()
