"""Workers that carry out runs: a pool of processes on this machine, or a Dask cluster. Neither loses a result."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from typing import TypeVar

from perch_core.errors import PerchError
from perch_core.processes import end_with_parent, without_interrupts
from perch_eval.campaign.causes import ERROR
from perch_eval.campaign.engines import Task, run_task
from perch_eval.campaign.results import RunResult
from perch_eval.extras import require
from perch_eval.revision import OtherCodeError, digest, require_code

T = TypeVar("T")
R = TypeVar("R")
TERMINATION_TIMEOUT = 5  # of a worker after SIGTERM [s]
ATTEMPTS = 3  # a run whose worker died so often is given up


_working = threading.Event()  # this process, a worker, is at work


def _on_terminate(*_: object) -> None:
    """End on SIGTERM; at work by SystemExit, so that nodes are stopped on the way out, with an alarm if that takes too long."""
    if not _working.is_set():
        os._exit(1)
    signal.alarm(TERMINATION_TIMEOUT)
    sys.exit(1)


def prepare_worker() -> None:
    """Set up the signals of a worker: the campaign alone handles Ctrl-C, and a worker ends with its campaign."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})  # what the worker starts has signals of its own
    signal.signal(signal.SIGTERM, _on_terminate)
    campaign = multiprocessing.parent_process()
    end_with_parent(signal.SIGTERM, None if campaign is None else campaign.pid)


def _call(work: Callable[[T], R], item: T) -> R:
    """Do the work; SystemExit ends the process. The pool would take it for the work's result, and the worker would never end."""
    try:
        _working.set()
        return work(item)
    except SystemExit:
        os._exit(1)
    finally:
        _working.clear()


def in_processes(work: Callable[[T], R], items: Sequence[T], jobs: int | None = None, on_worker_death: Callable[[T], R] | None = None
                 ) -> Iterator[tuple[T, R]]:
    """Yield (item, result) of work in processes, in order of completion.

    If a worker dies, the pool is broken, and any item that was in it may be the reason: each of them is repeated alone. Processes
    are spawned, not forked: BLAS threads of the parent do not survive a fork. The processes end with the process that waits for them.

    Args:
        work: function to be called, defined at module level.
        items: its arguments.
        jobs: number of processes; None: one per core.
        on_worker_death: returns the result of an item at which workers died `ATTEMPTS` times.

    Raises:
        PerchError: workers died `ATTEMPTS` times at an item, and there is no `on_worker_death`.
    """
    waiting = deque(items)
    while waiting:
        for suspect in (yield from _until_broken(work, waiting, jobs or os.cpu_count() or 1)):
            alone = deque([suspect])
            for _ in range(ATTEMPTS):
                alone.extend((yield from _until_broken(work, alone, 1)))
                if not alone:
                    break
            else:
                if on_worker_death is None:
                    raise PerchError(f"a process has died {ATTEMPTS} times at {suspect}")
                yield suspect, on_worker_death(suspect)


def _until_broken(work: Callable[[T], R], waiting: deque[T], jobs: int) -> Generator[tuple[T, R], None, list[T]]:
    """Yield (item, result) of the waiting items until all are done or the pool breaks; return the unfinished items that were in it."""
    pool = ProcessPoolExecutor(jobs, mp_context=multiprocessing.get_context("spawn"), initializer=prepare_worker)
    pending: dict[Future[R], T] = {}
    try:
        while waiting or pending:
            while waiting and len(pending) < 2 * jobs:
                with without_interrupts():  # a worker that has just been started would print where it was
                    pending[pool.submit(_call, work, waiting[0])] = waiting[0]  # raises where the pool has broken: it goes on waiting
                waiting.popleft()
            for future in wait(pending, return_when=FIRST_COMPLETED).done:
                result = future.result()
                yield pending.pop(future), result
    except BrokenProcessPool:
        finished = [future for future in pending if future.done() and future.exception() is None]
        yield from [(pending.pop(future), future.result()) for future in finished]
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)
        for process in multiprocessing.active_children():  # in the middle of what they do
            process.terminate()
        raise
    pool.shutdown(wait=True, cancel_futures=True)
    return list(pending.values())


def failed_run(task: Task, message: str = f"its worker died {ATTEMPTS} times") -> RunResult:
    """Return the result of a run whose workers died."""
    return RunResult(task.run.number, task.run.seed, ERROR, "failed", message, task.run.values)


def in_pool(tasks: Sequence[Task], jobs: int) -> Iterator[RunResult]:
    """Carry out runs of a campaign in `jobs` processes; yield results in order of completion."""
    for _, result in in_processes(run_task, tasks, jobs, failed_run):
        yield result


def _run_with_code(code: str, task: Task) -> RunResult:
    """Carry out a run on a worker, which must have the code of the campaign."""
    require_code(code, "a worker of the cluster has other code than the campaign; update it, and continue with --resume")
    return run_task(task)


def on_cluster(tasks: Sequence[Task], address: str) -> Iterator[RunResult]:
    """Carry out tasks on a Dask cluster, which repeats the unfinished tasks of a lost worker.

    Args:
        tasks: runs to be flown.
        address: address of the scheduler (`tcp://host:8786`).

    Raises:
        PerchError: the scheduler does not answer.
        OtherCodeError: a worker has other code than this process.
    """
    require("campaigns")
    from distributed import Client, as_completed

    try:
        client = Client(address, timeout="20s")
    except (OSError, TimeoutError, ValueError) as error:
        raise PerchError(f"--cluster {address}: {error or 'no answer from the scheduler'}") from None
    with client:
        code = digest()
        futures = {client.submit(_run_with_code, code, task, key=f"run-{task.run.number}-{id(tasks):x}", pure=False, retries=ATTEMPTS):
                   task for task in tasks}
        for future in as_completed(list(futures)):
            task = futures.pop(future)
            try:
                result = future.result()  # may be lost with its worker even now: Dask then carries it out again
            except OtherCodeError:
                raise
            except Exception as error:
                result = failed_run(task, f"{type(error).__name__}: {error}")
            future.release()
            yield result
