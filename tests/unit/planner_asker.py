"""A planner component that is asked without ROS, in this process or isolated."""

from __future__ import annotations

from typing import Any

from perch_core.component import Component
from perch_core.job import Job
from perch_core.isolated import IsolatedRunner


class Asked:
    """Asks a component; its jobs run at once or in a runner.

    Attributes:
        lines: what it has logged.
        jobs: those that it gave to the runner.
    """

    def __init__(self, component: Component[Any], service: str, runner: IsolatedRunner | None = None) -> None:
        self.component, self.runner = component, runner
        self.lines: list[str] = []
        self.jobs: list[Job] = []
        self._handler = getattr(component, f"on_{service}")
        component.log.receivers.append(lambda line: self.lines.append(line.text))
        if runner is not None:
            component.work = self._isolated

    def _isolated(self, job: Job) -> None:
        self.jobs.append(job)
        future = self.runner.submit(job)
        job.then(future.exception(60.0) or future.result())

    def __call__(self, asked: Any) -> Any:
        answers: list[Any] = []
        self._handler(asked, answers.append)
        answer, = answers
        return answer
