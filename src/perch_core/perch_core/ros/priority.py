"""Who goes first where processors are short: nodes with deadlines, then everyone, then work that has time."""

from __future__ import annotations

import os
import threading
from contextlib import suppress
from pathlib import Path

from perch_core.processes import give_way

PRIORITY = 10  # of SCHED_FIFO: above everything ordinary, below the kernel's own threads
NICE = 10      # of work that has time
SPINS = "dds.asyn"
"""Beginning of the names of Fast DDS's asynchronous writers, which send what is too large for one message. They spin while another
thread is about to remove a sample: at a priority that this thread cannot interrupt they keep it from its processor without end."""


class Priority:
    """Asks the operating system to run this process's loop before everything that has no deadline.

    Without it a busy program beside the nodes takes its fair share of the cores in slices of several milliseconds, longer than
    a control period. The thread of the callbacks and those of rclpy and the middleware are raised; threads of Python, which
    compile and solve, and those that `SPINS` names stay ordinary, and threads and processes that come later do not inherit it.
    """

    def __init__(self) -> None:
        self.nodes = 0  # that this process runs and does nothing else; 0: it is a test

    def ask(self) -> str:
        """Raise the threads; returns why that was not possible, or nothing."""
        if self.nodes == 0:
            return ""
        ordinary = {thread.native_id for thread in threading.enumerate() if thread is not threading.main_thread()}
        try:
            for task in _tasks() - ordinary:
                with suppress(ProcessLookupError, FileNotFoundError):
                    if Path(f"/proc/self/task/{task}/comm").read_text().startswith(SPINS):
                        continue
                    os.sched_setscheduler(task, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(PRIORITY))
        except PermissionError:
            return "no permission for real-time scheduling (ulimit -r): deadlines depend on what else runs here"
        return ""

    def give_way(self) -> None:
        """Let others go first: everyone waits for the chain of a simulated step, and a slow participant has its latency.

        Not where it shares its process: a neighbour may be of the chain.
        """
        if self.nodes == 1:
            for task in _tasks():
                with suppress(ProcessLookupError):
                    give_way(task, NICE)


def _tasks() -> set[int]:
    """Threads of this process by number; one of them may have ended when its number is used."""
    return {int(name) for name in os.listdir("/proc/self/task")}


priority = Priority()
