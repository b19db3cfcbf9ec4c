"""Mirrors `perch_planner.perching_planner_node`: the mission's queries to plans and refusals."""

from __future__ import annotations

import numpy as np

from perch_control.mission import PlanAnswer, PlanQuery
from perch_core import so3
from perch_core.errors import PerchError
from perch_core.surface import PerchSurface
from perch_core.trajectory import FlatTrajectory
from perch_core.vehicle import Vehicle
from perch_eval.in_process.stamps import published
from perch_planner.planner import plan
from perch_planner.problem import PerchProblem, PerchSettings, StartState


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
            planned = plan(PerchProblem(start, surface), self._settings, self._vehicle)
        except PerchError as error:
            return PlanAnswer(False, str(error))
        flat = FlatTrajectory(planned.trajectory.durations, planned.trajectory.coefficients, start_time)
        return PlanAnswer(True, f"contact after {planned.duration:.3f} s", flat, start_time, float(np.sum(flat.durations)))
