"""Flights of an evaluation, kept in a file: finished flights of the same code are reused, so that an evaluation can resume.

Without a digest of the code (outside a git repository) nothing is reused, nor are flights that could not be carried out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import asdict
from typing import Any, TypeVar

from perch_core.json_values import finite
from perch_eval.campaign.causes import ERROR, SUCCESS
from perch_eval.campaign.engines import Task, run_task
from perch_eval.campaign.progress import with_progress
from perch_eval.campaign.results import RunResult
from perch_eval.campaign.workers import failed_run, in_processes
from perch_eval.evaluation.document import Effort
from perch_eval.revision import require_code
from perch_eval.rows import Rows, rows_of

T = TypeVar("T")


def cached_figures(effort: Effort, name: str, jobs: Sequence[T], work: Callable[[T], dict[str, Any]],
                   good: Callable[[dict[str, Any]], bool], key: Callable[[T], str] = str,
                   on_worker_death: Callable[[T], dict[str, Any]] | None = None) -> list[dict[str, Any]]:
    """Return the figures of flights, one mapping per job, in the order of the jobs.

    Args:
        effort: number of processes, and folder of the kept figures.
        name: name of the file, and of what the progress line counts.
        jobs: jobs to be flown.
        work: flies one job, in another process.
        good: whether the figures count as good in the progress line.
        key: returns the key of a job in the file.
        on_worker_death: returns the figures of a job at which processes die repeatedly.

    Raises:
        PerchError: processes die repeatedly at a job, and there is no `on_worker_death`.
        OtherCodeError: the code was changed meanwhile; the flight that has just ended is not kept.
    """
    effort.state.mkdir(parents=True, exist_ok=True)
    code = effort.code["digest"]
    file = effort.state / f"{name}_{code}.jsonl"
    known: dict[str, dict[str, Any]] = {job: row for job, row in rows_of(file) if row.get("cause") != ERROR} if code else {}
    missing = [job for job in jobs if key(job) not in known]
    before = [known[key(job)] for job in jobs if key(job) in known]
    found = with_progress(in_processes(work, missing, effort.jobs, on_worker_death), len(jobs), lambda one: good(one[1]),
                          initial=len(before), initial_good=sum(map(good, before)), unit=name.replace("_", " "))
    with closing(Rows(file, known.items())) as rows:
        for job, result in found:
            require_code(code, "it was changed during the evaluation; start the evaluation again, which flies with the new code, or undo "
                               "the change, then it continues")
            known[key(job)] = finite(result)
            rows.add((key(job), known[key(job)]))
    return [known[key(job)] for job in jobs]


def cached_runs(effort: Effort, name: str, tasks: Sequence[Task],
                good: Callable[[RunResult], bool] = lambda r: r.cause == SUCCESS) -> list[RunResult]:
    """Return the results of tasks, which are kept by run number; other arguments as those of `cached_figures`."""
    found = cached_figures(effort, name, tasks, _run_task, lambda row: good(RunResult(**row)), lambda task: str(task.run.number),
                           lambda task: asdict(failed_run(task)))
    return [RunResult(**row) for row in found]


def _run_task(task: Task) -> dict[str, Any]:
    return asdict(run_task(task))
