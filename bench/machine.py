"""Effects of the machine itself on the timing of real-time programs."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path

from perch_core.processes import end_with_parent, without_interrupts
from perch_core.ros.priority import PRIORITY
from perch_sim.timing import CONTROL_PERIOD_NS

SPIN_TIME, SLEEP_TIME = 0.004, 0.001  # of a core, in turn; the sleep is so short that the host does not withdraw the core [s]

_spawn = multiprocessing.get_context("spawn")


@contextmanager
def cores_awake() -> Iterator[None]:
    """Keep the cores from sleeping, by work that yields to everything else.

    A sleeping core of a virtual machine is given away by its host and returns only after milliseconds; on physical real-time
    machines, idle=poll or the governor prevents this. The work has pauses: if all cores are busy throughout, a host with a quota
    per 100 ms withdraws them for the rest of the period, for up to 10 ms (docs/real_time.md).
    """
    processes = [_start(_spin) for _ in range(os.cpu_count() or 1)]
    try:
        yield
    finally:
        for process in processes:
            process.terminate()
            process.join()


class LateWakeUps:
    """Counts late wake-ups, by more than a period, of a program that only wakes once per control period at a priority above the
    nodes: a lower bound for every node. Linux, with permission for real-time scheduling; otherwise at normal priority."""

    def __init__(self) -> None:
        self._pipe, theirs = _spawn.Pipe()
        self._process = _start(_wake, theirs)

    def share(self) -> float:
        """Percentage of late wake-ups since the start; ends the counting."""
        self._pipe.send(None)
        late, all_of_them = self._pipe.recv()
        self._process.join()
        return 100.0 * late / max(1, all_of_them)


def late_with_load(load: float, seconds: float) -> float:
    """Return the percentage of periods in which a loop that only computes for a given time per period is late by more than a
    period, which is due to the machine alone.

    Args:
        load: processor time per period [s].
        seconds: how long it runs.
    """
    ours, theirs = _spawn.Pipe()
    process = _start(_compute, theirs, load, seconds)
    late = ours.recv()
    process.join()
    return late


class StolenTime:
    """Stolen time: processor time since the start that the host of a virtual machine gave to others while a program here was
    runnable; in ticks of 10 ms, as far as the host reports it. Linux."""

    def __init__(self, stat: Path = Path("/proc/stat")) -> None:
        self._stat = stat
        self._begin = time.monotonic(), self._total()

    def share(self) -> float:
        """Percentage of the time of all cores."""
        begin, before = self._begin
        return 100.0 * (self._total() - before) / ((time.monotonic() - begin) * (os.cpu_count() or 1))

    def _total(self) -> float:
        """Return the stolen time of all cores [s]: the eighth value of the first line."""
        return int(self._stat.read_text().split(maxsplit=9)[8]) / os.sysconf("SC_CLK_TCK")


def _start(work, *arguments) -> BaseProcess:
    process = _spawn.Process(target=_work_until_parent_ends, args=(os.getpid(), work, *arguments), daemon=True)
    with without_interrupts():
        process.start()
    return process


def _work_until_parent_ends(parent: int, work, *arguments) -> None:
    """Call `work` in a process that ends with its parent, also with one that is killed or ends at once on Ctrl-C."""
    end_with_parent(signal.SIGKILL, parent)
    work(*arguments)


def _schedule(policy: str, priority: int) -> None:
    """Set the scheduling of this process, if Linux permits it."""
    with suppress(OSError, AttributeError):
        os.sched_setscheduler(0, getattr(os, policy), os.sched_param(priority))


def _sleep_until(due: int) -> None:
    time.sleep(max(0, due - time.monotonic_ns()) * 1e-9)


def _spin() -> None:
    _schedule("SCHED_IDLE", 0)
    while True:
        rest = time.monotonic() + SPIN_TIME
        while time.monotonic() < rest:
            pass
        time.sleep(SLEEP_TIME)


def _compute(pipe: Connection, load: float, seconds: float) -> None:
    _schedule("SCHED_FIFO", PRIORITY)
    periods = round(seconds * 1e9 / CONTROL_PERIOD_NS)
    due, late = time.monotonic_ns(), 0
    for _ in range(periods):
        due += CONTROL_PERIOD_NS
        _sleep_until(due)
        end = time.thread_time() + load
        while time.thread_time() < end:
            pass
        late += time.monotonic_ns() - due > 2 * CONTROL_PERIOD_NS
    pipe.send(100.0 * late / periods)


def _wake(pipe: Connection) -> None:
    _schedule("SCHED_FIFO", 50)
    due, late, count = time.monotonic_ns(), 0, 0
    while not pipe.poll():
        due += CONTROL_PERIOD_NS
        _sleep_until(due)
        behind = (time.monotonic_ns() - due) // CONTROL_PERIOD_NS  # whole periods: this one and those slept over are late
        late, count, due = late + behind, count + 1 + behind, due + behind * CONTROL_PERIOD_NS
    pipe.send((late, count))
