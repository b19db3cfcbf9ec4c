"""Mirrors both planners' nodes: the mission's queries to plans and refusals."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from perch_msgs.srv import PlanPowerline

from perch_control.mission import PlanAnswer, PlanQuery
from perch_control.ros.planner_clients import plan_answer, powerline_request
from perch_core import so3
from perch_core.errors import PerchError
from perch_core.rotor_model import RotorModel
from perch_core.surface import PerchSurface
from perch_core.trajectory import FlatTrajectory
from perch_core.vehicle import Vehicle, load_vehicle
from perch_eval.in_process.stamps import published
from perch_planner.planner import plan
from perch_planner.powerline import PowerlinePlanner
from perch_planner.powerline_planner_node import PowerlinePlannerParameters
from perch_planner.problem import PerchProblem, PerchSettings, StartState
from perch_planner.ros import powerline_messages


class Planning:
    """Answers plan queries at once; when an answer counts is the mission's matter."""

    def __init__(self, settings: PerchSettings, vehicle: Vehicle) -> None:
        self._settings, self._vehicle = settings, vehicle

    def answer(self, query: PlanQuery) -> PlanAnswer:
        """The plan for a query, or why there is none."""
        start_time = published(query.start_time)
        try:
            surface = PerchSurface(query.target.p_WS, so3.quat_to_matrix(query.target.q_WS), (1.0, 1.0))
            if query.current is not None:
                start = StartState.on(query.current, start_time - query.current.start_time)
            else:
                start = StartState(query.p, query.v, query.a, query.j, float(query.yaw))
            times = None if query.duration is None else (query.duration,)
            planned = plan(PerchProblem(start, surface, segment_times=times), self._settings, self._vehicle)
        except PerchError as error:
            return PlanAnswer(False, str(error))
        flat = FlatTrajectory(planned.trajectory.durations, planned.trajectory.coefficients, start_time)
        return PlanAnswer(True, f"contact after {planned.duration:.3f} s", flat, start_time, float(np.sum(flat.durations)))


class PowerlinePlanning:
    """Answers plan queries for cables, in this process instead of one that can be stopped."""

    def __init__(self, params: PowerlinePlannerParameters) -> None:
        self._params, self._vehicle = params, load_vehicle(params.vehicle)
        self._model = RotorModel.of(self._vehicle)
        self._planner = _planner(params)

    def answer(self, query: PlanQuery) -> PlanAnswer:
        """The plan for a query, or why there is none."""
        msg, response = powerline_request(query), PlanPowerline.Response()
        try:
            plan = self._planner.plan(powerline_messages.powerline_request(msg, self._model, self._vehicle.wire_offset))
        except PerchError as error:
            response.message = str(error)
        else:
            powerline_messages.fill_response(response, plan, self._model, self._params.sample_step, self._params.contact_time)
            response.trajectory.header.stamp = msg.start_time
        return plan_answer(response)


@lru_cache(maxsize=2)
def _planner(params: PowerlinePlannerParameters) -> PowerlinePlanner:
    """The planner with everything that its first plan would load; kept for the next flight of this process."""
    planner = PowerlinePlanner(load_vehicle(params.vehicle), params)
    planner.warm_up()
    return planner
