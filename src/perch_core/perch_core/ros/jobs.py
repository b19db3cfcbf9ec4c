"""Execution of a component's jobs outside the executor's thread."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

from perch_core.job import Job
from perch_core.errors import PerchError
from perch_core.isolated import IsolatedRunner


class Jobs:
    """Runs jobs on one thread, or in one process that can be killed, in the order of their submission."""

    def __init__(self, deliver: Callable[..., None], preload: Callable[[], None] | None) -> None:
        """
        Args:
            deliver: `deliver(function, argument)` calls a function on the executor's thread; any thread may call it.
            preload: loads what isolated jobs use; None: there are no isolated jobs, or they load it themselves.
        """
        self._deliver = deliver
        self._thread: ThreadPoolExecutor | None = None
        self._process = IsolatedRunner(preload) if preload is not None else None

    def wait_ready(self) -> None:
        """Wait until isolated jobs can begin at once.

        Raises:
            PerchError: what they need cannot be loaded.
        """
        if self._process is not None and not self._process.wait_ready():
            raise PerchError("the process for isolated jobs did not start within its time-out")

    def submit(self, job: Job) -> None:
        """Submit a job; it begins after the jobs before it, and `job.then` receives its result."""
        if job.isolated:
            if self._process is None:
                self._process = IsolatedRunner()
            future = self._process.submit(job)
        else:
            if self._thread is None:
                self._thread = ThreadPoolExecutor(1, "job")
            future = self._thread.submit(job.function, *job.arguments)
        future.add_done_callback(lambda done: self._done(job, done))

    def _done(self, job: Job, future: Future[Any]) -> None:
        if future.cancelled():
            return
        error = future.exception()
        if error is not None and not isinstance(error, PerchError):
            error = PerchError(f"{job.function.__name__} failed: {type(error).__name__}: {error}")
        self._deliver(job.then, error if error is not None else future.result())

    def close(self) -> None:
        """Stop isolated jobs; a job on the thread runs to its end."""
        if self._process is not None:
            self._process.close()
        if self._thread is not None:
            self._thread.shutdown(wait=False, cancel_futures=True)
