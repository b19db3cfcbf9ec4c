"""Long computations of a component, which its host runs outside the component's thread."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from perch_core.errors import PerchError


class JobStopped(PerchError):
    """A job did not end within its time limit."""


class JobFailed(PerchError):
    """An isolated job has no result: it was refused, crashed, ran out of memory, or raised an unexpected exception."""


@dataclass(frozen=True)
class Job:
    """Long computation, `function(*arguments)`, that the host runs outside the component's thread.

    Attributes:
        function: module-level function; where `isolated`, it, `arguments` and its result must be picklable.
        arguments: its arguments.
        then: called on the component's thread with the result, or with the exception that ended the job.
        limit: wall-clock time from submission [s], after which the job ends with `JobStopped`; None: no limit. The time spent
            waiting for earlier jobs counts.
        isolated: run in a process that can be killed; otherwise on a thread, to which `limit` does not apply.
    """

    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    then: Callable[[Any], None]
    limit: float | None = None
    isolated: bool = False


def run_now(job: Job) -> None:
    """Run a job at once, on the caller's thread and without a limit."""
    try:
        result = job.function(*job.arguments)
    except PerchError as error:
        result = error
    job.then(result)
