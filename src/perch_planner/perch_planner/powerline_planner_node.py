"""Node `powerline_planner`: service `plan_powerline`, the powerline NLP behind messages. [P:V]"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from queue import Queue
from threading import Thread
from typing import Any

from perch_msgs.srv import PlanPowerline

from perch_core.config import quantity, text
from perch_core.errors import ConfigError, PerchError, PlanningRefusal
from perch_core.ros.node import PerchNode, spin_main
from perch_core.rotor_model import RotorModel
from perch_core.vehicle import load_vehicle
from perch_planner.powerline.settings import PowerlineSettings
from perch_planner.powerline.worker import START_TIMEOUT, PowerlineWorker
from perch_planner.ros.late_service import LateService
from perch_planner.ros.powerline_messages import fill_response, powerline_request

_RESPONSE = PlanPowerline.Response
_ERROR_CODES = {
    "bad_input": _RESPONSE.BAD_INPUT, "empty_map": _RESPONSE.EMPTY_MAP, "perch_in_collision": _RESPONSE.PERCH_IN_COLLISION,
    "start_invalid": _RESPONSE.START_INVALID, "infeasible": _RESPONSE.INFEASIBLE, "deadline": _RESPONSE.DEADLINE,
    "solver": _RESPONSE.SOLVER,
}


@dataclass(frozen=True, kw_only=True)
class PowerlinePlannerParameters(PowerlineSettings):
    """Parameters of the node: those of the planner, the vehicle it plans for, and how finely it answers."""

    vehicle: str = text("rpg", doc="config/vehicles/<name>.yaml, or a file")
    sample_step: float = quantity(0.004, unit="s", low=0.001, high=0.05, doc="spacing of the trajectory's points")
    contact_time: float = quantity(0.1, unit="s", low=0.0, high=10.0, doc="wait for the grip after a perch without recovery")


@dataclass(frozen=True)
class _Job:
    """A request, where its answer goes, and when it came."""

    request: PlanPowerline.Request
    answer: Callable[[PlanPowerline.Response], None]
    arrived: float


class PowerlinePlannerNode(PerchNode[PowerlinePlannerParameters]):
    """Requests to the planning process, plans and refusals to responses.

    The service appears when the planning process is ready: the first time on a machine it compiles for some 15 s. Requests
    are solved one after the other by a thread of their own; the node goes on meanwhile. Deadlines count from the arrival.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("powerline_planner", PowerlinePlannerParameters, **kwargs)
        self._closing = False
        self._vehicle = load_vehicle(self.params.vehicle)
        if self.params.camera not in self._vehicle.mounts:
            raise ConfigError(self.get_name(), "camera", f"vehicle {self._vehicle.name} has no camera {self.params.camera!r}")
        if not math.isfinite(self._vehicle.thrust_rate_max):
            raise ConfigError(self.get_name(), "vehicle", f"{self._vehicle.name} has no thrust_rate_max, which [P:eq14g] needs")
        self._model = RotorModel.of(self._vehicle)
        self._worker = PowerlineWorker(self._vehicle, self.params)
        try:
            if not self._worker.wait_ready():
                raise ConfigError(self.get_name(), "", f"the planning process was not ready after {START_TIMEOUT:g} s")
        except PerchError:
            self.close()
            raise
        self._jobs: Queue[_Job | None] = Queue()
        self._thread = Thread(target=self._solve_all, name="plan_powerline", daemon=True)
        self._thread.start()
        self._service = LateService(self, PlanPowerline, "plan_powerline", self._plan)

    def close(self) -> None:
        """End the planning process, in the middle of a solve, too."""
        self._closing = True
        self._worker.close()
        if hasattr(self, "_thread") and self._thread.is_alive():
            self._jobs.put(None)
            self._thread.join(timeout=1.0)

    def destroy_node(self) -> None:
        """End the planning process with the node, also where no main loop calls `close`."""
        if hasattr(self, "_worker"):
            self.close()
        super().destroy_node()

    def _plan(self, request: PlanPowerline.Request, answer: Callable[[PlanPowerline.Response], None]) -> None:
        self._jobs.put(_Job(request, answer, time.monotonic()))

    def _solve_all(self) -> None:
        """Answer the requests in the order of their arrival; runs in the thread."""
        while (job := self._jobs.get()) is not None and not self._closing:
            response = self._solve(job)
            if self._closing:
                return
            if not response.success:
                self.get_logger().warning(f"no plan: {response.message}")
            job.answer(response)

    def _solve(self, job: _Job) -> PlanPowerline.Response:
        request, response = job.request, PlanPowerline.Response()
        try:
            deadline = float(request.deadline) if request.deadline != 0 else self.params.deadline
            if not math.isfinite(deadline):
                raise PlanningRefusal("bad_input", "deadline", -1.0, f"deadline {deadline} s is not finite")
            asked = powerline_request(request, self._model, self._vehicle.wire_offset)
            waited = time.monotonic() - job.arrived
            if 0.0 < deadline <= waited:
                raise PlanningRefusal("deadline", "wall-clock time", deadline - waited,
                                      f"no plan within {deadline:g} s: other requests were being solved; ask again")
            plan = self._worker.plan(asked, deadline - waited if deadline > 0.0 else deadline)
        except PlanningRefusal as refusal:
            response.error_code, response.message = _ERROR_CODES[refusal.code], str(refusal)
        except PerchError as error:
            response.error_code, response.message = _RESPONSE.BAD_INPUT, str(error)
        except OSError as error:  # the pipe of a planning process that is being ended
            response.error_code, response.message = _RESPONSE.SOLVER, f"the planning process ended: {error}"
        else:
            fill_response(response, plan, self._model, self.params.sample_step, self.params.contact_time)
            response.trajectory.header.stamp = request.start_time
        return response


def create(**kwargs: Any) -> PowerlinePlannerNode:
    """The node, for its own process or a composed one."""
    return PowerlinePlannerNode(**kwargs)


def main() -> None:
    """Entry point of the executable `powerline_planner`."""
    spin_main(create)
