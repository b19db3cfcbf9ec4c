"""Flights of an evaluation, kept in a file: finished flights of the same code are reused, so that an evaluation can resume."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import asdict
from typing import Any, TypeVar

from perch_core.json_values import finite
from perch_eval.campaign.causes import SUCCESS
from perch_eval.campaign.engines import Task, carry_out
from perch_eval.campaign.progress import counted
from perch_eval.campaign.results import RunResult
from perch_eval.campaign.workers import dead, in_processes
from perch_eval.evaluation.sections import Effort
from perch_eval.revision import digest
from perch_eval.rows import Rows, rows_of

T = TypeVar("T")


def computed(effort: Effort, name: str, jobs: Sequence[T], work: Callable[[T], dict[str, Any]], good: Callable[[dict[str, Any]], bool],
             key: Callable[[T], str] = str, dead: Callable[[T], dict[str, Any]] | None = None) -> list[dict[str, Any]]:
    """Return the figures of flights, one mapping per job, in the order of the jobs.

    Args:
        effort: number of processes, and folder of the kept figures.
        name: name of the file, and of what the progress line counts.
        jobs: jobs to be flown.
        work: flies one job, in another process.
        good: whether the figures count as good in the progress line.
        key: returns the key of a job in the file.
        dead: returns the figures of a job at which processes die repeatedly.

    Raises:
        PerchError: processes die repeatedly at a job, and there is no `dead`.
    """
    effort.state.mkdir(parents=True, exist_ok=True)
    file = effort.state / f"{name}_{digest()}.jsonl"
    known: dict[str, dict[str, Any]] = {} if effort.fresh else dict(rows_of(file))
    missing = [job for job in jobs if key(job) not in known]
    before = [known[key(job)] for job in jobs if key(job) in known]
    found = counted(in_processes(work, missing, effort.jobs, dead), len(jobs), lambda one: good(one[1]), already=len(before),
                    good_already=sum(map(good, before)), what=name.replace("_", " "))
    with closing(Rows(file, known.items())) as rows:
        for job, result in found:
            known[key(job)] = finite(result)
            rows.add((key(job), known[key(job)]))
    return [known[key(job)] for job in jobs]


def flown(effort: Effort, name: str, tasks: Sequence[Task], good: Callable[[RunResult], bool] = lambda r: r.cause == SUCCESS) -> list[RunResult]:
    """Return the results of tasks, which are kept by run number; other arguments as those of `computed`."""
    found = computed(effort, name, tasks, _carried_out, lambda row: good(RunResult(**row)), lambda task: str(task.run.number),
                     lambda task: asdict(dead(task)))
    return [RunResult(**row) for row in found]


def _carried_out(task: Task) -> dict[str, Any]:
    return asdict(carry_out(task))
