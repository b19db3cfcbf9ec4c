"""Powerline planner component: answers requests of `plan_powerline` with plans or typed refusals. [P:V]"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import lru_cache, partial
from typing import Any

from perch_core.component import Component, Diagnostics, Service
from perch_core.config import text
from perch_core.errors import PerchError, PlanningRefusal
from perch_core.job import Job, JobStopped
from perch_core.rotor_model import RotorModel
from perch_core.values import PowerlinePlan, PowerlinePlanRequest, limits
from perch_core.vehicle import load_vehicle
from perch_planner.powerline import service
from perch_planner.powerline.planner import PowerlinePlanner
from perch_planner.powerline.request import PowerlineRequest
from perch_planner.powerline.settings import DEADLINE_MAX, PowerlineSettings

FIRST_SHARE = 0.6  # of the deadline: when the first solver has not answered by then, ipopt gets the rest
_FALLBACK_MIN = 0.05  # it needs more than that [s]


@dataclass(frozen=True, kw_only=True)
class PowerlinePlannerParameters(PowerlineSettings):
    """Parameters of the component: those of the planner, and the vehicle it plans for."""

    vehicle: str = text("rpg", doc="config/vehicles/<name>.yaml, or a file")


@dataclass(frozen=True)
class Task:
    """Input of a planning job.

    Attributes:
        vehicle: name or file.
        settings: of the planner.
        request: request of the planner.
        start: as in `service.plan_response`.
    """

    vehicle: str
    settings: PowerlineSettings
    request: PowerlineRequest
    start: int


class PowerlinePlannerComponent(Component[PowerlinePlannerParameters]):
    """Plans perches on lines; each plan is a job that the host may run in another process.

    A deadline counts from the request and includes the wait for earlier requests. Where the first solver is stopped at 60 % of
    it, ipopt gets the rest.
    """

    config_type = PowerlinePlannerParameters
    changeable = ("deadline",)

    plan_powerline = Service(PowerlinePlanRequest, PowerlinePlan, "plan_powerline")

    def __init__(self, config: PowerlinePlannerParameters) -> None:
        super().__init__(config)
        self._vehicle = load_vehicle(config.vehicle)
        self._model = RotorModel.of(self._vehicle)
        # The deadline may change, and goes with each request.
        planner_settings = {field.name: getattr(config, field.name) for field in fields(PowerlineSettings)}
        self._settings = PowerlineSettings(**planner_settings | {"deadline": PowerlineSettings.deadline})
        self._settings.check(self._vehicle)

    def preload(self) -> Callable[[], Any]:
        """Return the function that loads the planner, and compiles it the first time on a machine."""
        return partial(cached_planner, self.config.vehicle, self._settings)

    def on_plan_powerline(self, request: PowerlinePlanRequest, reply: Callable[[PowerlinePlan], None]) -> None:
        """Plan a perch or recovery, and reply with the plan or a refusal."""
        try:
            service.check_request(request)
            deadline = min(float(request.deadline or self.config.deadline), DEADLINE_MAX)
            converted = replace(service.planner_request(request, self._model, self._vehicle.wire_offset), deadline=deadline)
        except PerchError as error:
            self._reply(request, reply, error)
            return
        task = Task(self.config.vehicle, self._settings, converted, request.start)
        self._start_jobs(request, reply, task)

    def _start_jobs(self, request: PowerlinePlanRequest, reply: Callable[[PowerlinePlan], None], task: Task) -> None:
        """Start the job of a task with a share of its deadline; ipopt gets the rest where that job is stopped."""
        deadline = task.request.deadline
        rest = (1.0 - FIRST_SHARE) * deadline

        def on_first_result(found: Any) -> None:
            if not isinstance(found, JobStopped):
                self._reply(request, reply, found)
            elif rest > _FALLBACK_MIN:
                fallback = replace(task, request=replace(task.request, solver="ipopt", deadline=rest))
                self.work(Job(solve, (fallback,), partial(self._reply_last, request, reply, deadline), rest, isolated=True))
            else:
                self._reply_last(request, reply, deadline, found)

        first = replace(task, request=replace(task.request, deadline=FIRST_SHARE * deadline))  # the planner gets the time at which it will be stopped
        self.work(Job(solve, (first,), on_first_result, FIRST_SHARE * deadline, isolated=True))

    def _reply_last(self, request: PowerlinePlanRequest, reply: Callable[[PowerlinePlan], None], deadline: float, found: Any) -> None:
        if isinstance(found, JobStopped):
            found = PlanningRefusal("deadline", "wall-clock time", -1.0, f"no plan within {deadline:g} s ({found}); allow more time, "
                                                                         "retry, or start from elsewhere")
        self._reply(request, reply, found)

    def _reply(self, request: PowerlinePlanRequest, reply: Callable[[PowerlinePlan], None], found: Any) -> None:
        """Reply with a plan, or with the error that occurred instead."""
        if isinstance(found, PowerlinePlan):
            answer = found
        else:
            answer = service.refusal_response(found)
            self.warn(f"no plan: {answer.message}")
        self.diagnostics(Diagnostics(limits.stamp_of(request), {
            "success": answer.success, "error_code": int(answer.error_code), "iterations": answer.iterations,
            "solve_ms": 1e3 * answer.solve_time, "recovery_solve_ms": 1e3 * answer.recovery_solve_time, "solver": answer.solver}))
        reply(answer)


@lru_cache(maxsize=2)
def cached_planner(vehicle: str, settings: PowerlineSettings) -> PowerlinePlanner:
    """Return a planner with everything loaded that its first plan needs; cached for the next plans of this process."""
    planner = PowerlinePlanner(load_vehicle(vehicle), settings)
    planner.warm_up()
    return planner


def solve(task: Task) -> PowerlinePlan:
    """Plan, as the job of a request.

    Raises:
        PlanningRefusal: no plan was found; code `solver` after an unexpected error.
    """
    planner = cached_planner(task.vehicle, task.settings)
    try:
        return service.plan_response(planner.plan(task.request), planner.solver.model, task.start)
    except (PerchError, MemoryError):
        raise
    except Exception as error:  # every request must be answered
        raise PlanningRefusal("solver", "numerics", -math.inf, f"planning failed: {type(error).__name__}: {error}") from error
