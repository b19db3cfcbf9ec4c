"""Scheduling priorities on busy processors: nodes with deadlines first, then ordinary threads, then work without urgency."""

from __future__ import annotations

import os
import threading
from contextlib import suppress
from pathlib import Path

from perch_core.processes import lower_priority

PRIORITY = 10  # of SCHED_FIFO: above everything ordinary, below the kernel's own threads
NICE = 10      # of work without urgency
SPINNING_THREADS = "dds.asyn"
"""Prefix of the names of Fast DDS's asynchronous writer threads, which send data too large for one packet. They spin while
another thread is about to remove a sample: at a priority that this thread cannot preempt, they would block it for ever."""


class Priority:
    """Scheduling priority of this process's threads: real time for the callbacks, or lower than ordinary for slow participants.

    Without real-time priority, other busy programs take their share of the cores in slices of several milliseconds, longer than
    a control period. `raise_priority` raises the thread of the callbacks and those of rclpy and the middleware. Python's threads,
    which compile and solve, and `SPINNING_THREADS` remain ordinary; threads and processes started later do not inherit it.
    """

    def __init__(self) -> None:
        self.nodes = 0  # that this process runs and does nothing else; 0: it is a test

    def raise_priority(self) -> str:
        """Raise the threads; return why that was not possible, or an empty string."""
        if self.nodes == 0:
            return ""
        ordinary = {thread.native_id for thread in threading.enumerate() if thread is not threading.main_thread()}
        try:
            for task in _tasks() - ordinary:
                with suppress(ProcessLookupError, FileNotFoundError):
                    if Path(f"/proc/self/task/{task}/comm").read_text().startswith(SPINNING_THREADS):
                        continue
                    os.sched_setscheduler(task, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(PRIORITY))
        except PermissionError:
            return "no permission for real-time scheduling (ulimit -r): deadlines may be missed under load"
        return ""

    def lower_priority(self) -> None:
        """Lower the priority of this process: all wait for the chain of a simulated step, while a slow participant has a latency.

        Nothing is done if several nodes share the process, as a neighbour may be part of the chain.
        """
        if self.nodes == 1:
            for task in _tasks():
                with suppress(ProcessLookupError):
                    lower_priority(task, NICE)


def _tasks() -> set[int]:
    """Return the ids of this process's threads; a thread may have ended when its id is used."""
    return {int(name) for name in os.listdir("/proc/self/task")}


priority = Priority()
