"""Flights of an evaluation: those of the same code that an earlier one has flown are kept, so that an interrupted one goes on."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from perch_eval.campaign.causes import SUCCESS
from perch_eval.campaign.engines import Task
from perch_eval.campaign.progress import Progress
from perch_eval.campaign.results import Results, RunResult
from perch_eval.campaign.workers import in_pool, spread
from perch_eval.evaluation.sections import Effort
from perch_eval.page import finite
from perch_eval.revision import digest


def _file(effort: Effort, name: str, ending: str) -> tuple[Path, str]:
    """What holds flights of this code, and the code's digest."""
    effort.state.mkdir(parents=True, exist_ok=True)
    code = digest()
    file = effort.state / f"{name}_{code}{ending}"
    for old in effort.state.glob(f"{file.name}*") if effort.fresh else ():
        old.unlink()
    return file, code


def flown(effort: Effort, name: str, tasks: Sequence[Task], good: Callable[[RunResult], bool] = lambda r: r.cause == SUCCESS) -> list[RunResult]:
    """Runs of a campaign's engine.

    Args:
        effort: processes, and where results are kept.
        name: of the file, and what is counted.
        tasks: a run keeps its number when others are added.
        good: what is counted as good on the way.
    """
    file, code = _file(effort, name, ".sqlite")
    results, numbers = Results(file, name, code, resume=True), {task.run.number for task in tasks}
    try:
        known = {r.number: r for r in results.all() if r.number in numbers}
        progress = Progress(len(tasks), len(known), sum(map(good, known.values())), name.replace("_", " "))
        for result in in_pool([task for task in tasks if task.run.number not in known], effort.jobs):
            results.add(result)
            progress.add(good(result))
        progress.close()
        return [r for r in results.all() if r.number in numbers]
    finally:
        results.close()


def computed(effort: Effort, name: str, jobs: Sequence[Any], carry_out: Callable[[Any], dict[str, Any]], good: Callable[[dict[str, Any]], bool]
             ) -> list[dict[str, Any]]:
    """Figures of flights that are no campaign's, a mapping each; arguments as those of `flown`, `carry_out` flies one job in a process."""
    file, _ = _file(effort, name, ".json")
    known: dict[str, dict[str, Any]] = json.loads(file.read_text()) if file.exists() else {}
    missing = [job for job in jobs if str(job) not in known]
    progress = Progress(len(jobs), len(jobs) - len(missing), what=name)
    for result, job in zip(spread(carry_out, effort.jobs, progress, missing, good=good), missing):  # the results first: all are asked for
        known[str(job)] = finite(result)
        temporary = file.with_suffix(".part")
        temporary.write_text(json.dumps(known))
        temporary.replace(file)
    return [known[str(job)] for job in jobs]
