"""Where runs are carried out: a pool of processes on this machine, or a Dask cluster. Neither loses a result."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from typing import Any, TypeVar

from perch_core.errors import PerchError
from perch_core.processes import end_with_parent, without_interrupts
from perch_eval.campaign.engines import Task, carry_out
from perch_eval.campaign.progress import Progress
from perch_eval.campaign.results import RunResult
from perch_eval.extras import require

T = TypeVar("T")
END_LIMIT = 5  # of a worker that is told to end [s]
ATTEMPTS = 3  # a run whose worker died so often is given up


def _end(*_: object) -> None:
    """An exception, so that nodes are stopped on the way out; the pool takes one out of a run for its result, so there is a limit."""
    signal.alarm(END_LIMIT)
    sys.exit(1)


def prepare_worker() -> None:
    """Ctrl-C is the campaign's own matter, and no worker outlives its campaign."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})  # what the worker starts has signals of its own
    signal.signal(signal.SIGTERM, _end)
    end_with_parent(signal.SIGTERM)
    campaign = multiprocessing.parent_process()
    if campaign is not None and os.getppid() != campaign.pid:  # it has ended while this worker was starting
        os._exit(1)


def _carry_out(task: Task) -> RunResult:
    """As `carry_out`; told to stop in mid-run, the pool would take that for the run's own end, and wait for ever for another."""
    try:
        return carry_out(task)
    except SystemExit:
        os._exit(1)


def spread(work: Callable[..., T], jobs: int | None, progress: Progress, *columns: Iterable[Any], good: Callable[[T], bool] = lambda _: True
           ) -> Iterator[T]:
    """`map` in processes, which are not forked: BLAS threads of the parent do not survive a fork.

    Args:
        work: to be done, a function of a module.
        jobs: processes; None: one on each core.
        progress: told of each result, and closed at the end.
        columns: arguments of `work`.
        good: what is counted as good on the way.
    """
    pool = _pool(jobs)
    try:
        with without_interrupts():  # a worker that has just been started would print where it was
            results = pool.map(work, *columns)
        for result in results:
            progress.add(good(result))
            yield result
    except BaseException:
        _abandon(pool)
        raise
    finally:
        progress.close()
    pool.shutdown()


def _pool(jobs: int | None) -> ProcessPoolExecutor:
    return ProcessPoolExecutor(jobs, mp_context=multiprocessing.get_context("spawn"), initializer=prepare_worker)


def _abandon(pool: ProcessPoolExecutor) -> None:
    """End its processes in the middle of what they do."""
    pool.shutdown(wait=False, cancel_futures=True)
    for process in multiprocessing.active_children():
        process.terminate()


def dead(task: Task, why: str) -> RunResult:
    """The result of a run whose workers died."""
    return RunResult(task.run.number, task.run.seed, "error", "failed", why, task.run.values)


def in_pool(tasks: Sequence[Task], jobs: int) -> Iterator[RunResult]:
    """Carry out tasks in `jobs` processes; results come as they are finished.

    A worker that dies takes the pool with it: it is made anew, and what was under way is carried out again.
    """
    waiting, attempts = list(reversed(tasks)), {}
    while waiting:
        pool = _pool(jobs)
        under_way: dict[Future, Task] = {}
        try:
            while waiting or under_way:
                while waiting and len(under_way) < 2 * jobs:
                    task = waiting[-1]
                    with without_interrupts():
                        under_way[pool.submit(_carry_out, task)] = task  # raises where the pool has broken: the task goes on waiting
                    waiting.pop()
                done, _ = wait(under_way, return_when=FIRST_COMPLETED)
                for future in done:
                    result = future.result()
                    del under_way[future]
                    yield result
        except BrokenProcessPool:
            for future, task in under_way.items():
                if future.done() and future.exception() is None:
                    yield future.result()
                    continue
                attempts[task.run.number] = attempts.get(task.run.number, 0) + 1
                if attempts[task.run.number] >= ATTEMPTS:
                    yield dead(task, f"its worker died {ATTEMPTS} times")
                else:
                    waiting.append(task)
        except BaseException:
            _abandon(pool)
            raise
        pool.shutdown(wait=True, cancel_futures=True)


def on_cluster(tasks: Sequence[Task], address: str) -> Iterator[RunResult]:
    """Carry out tasks on a Dask cluster; Dask repeats what a lost worker had under way.

    Args:
        tasks: what to carry out.
        address: of the scheduler (`tcp://host:8786`).

    Raises:
        PerchError: the scheduler does not answer.
    """
    require("campaigns")
    from distributed import Client, as_completed

    try:
        client = Client(address, timeout="20s")
    except (OSError, TimeoutError, ValueError) as error:
        raise PerchError(f"--cluster {address}: {error or 'no answer from the scheduler'}") from None
    with client:
        futures = {client.submit(carry_out, task, key=f"run-{task.run.number}-{id(tasks):x}", pure=False, retries=ATTEMPTS):
                   task for task in tasks}
        for future in as_completed(list(futures)):
            task = futures.pop(future)
            try:
                result = future.result()  # may be lost with its worker even now: Dask then carries it out again
            except Exception as error:
                result = dead(task, f"{type(error).__name__}: {error}")
            future.release()
            yield result
