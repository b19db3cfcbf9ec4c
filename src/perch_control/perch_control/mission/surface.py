"""A perch on an inclined surface, marked by a board of tags. [M]"""

from __future__ import annotations

from perch_control.mission.perching import PerchingMission
from perch_control.mission.running_perch import RunningPerch
from perch_control.mission.values import Command, Inputs, Outputs, Plan, PlanQuery, Refusal, Target
from perch_control.mission.ways_out import WaysOut


class SurfaceMission(PerchingMission[RunningPerch]):
    """Find the pad, plan, perch; re-plan to the pad as seen from closer, if requested. Ways out of the plan are kept ready."""

    no_target_message = "no tags detected"
    _pending_way_out: tuple[PlanQuery, WaysOut] | None = None
    _replan_pending = False  # a new plan has been requested, and not answered

    @property
    def latency(self) -> float:
        """Latency of a plan for a surface, from a hover or in flight [s]."""
        return self.settings.planner_latency

    def running(self, plan: Plan, target: Target) -> RunningPerch:
        """Return a plan in flight; queries of an earlier attempt are discarded."""
        self._pending_way_out, self._replan_pending = None, False
        return RunningPerch.from_plan(plan, target, self.settings)

    def update_plan(self, inputs: Inputs, outputs: Outputs) -> None:
        """Re-plan to the target as seen from closer, and keep ways out ready."""
        if inputs.way_out is not None and self._pending_way_out is not None:
            (query, ways), self._pending_way_out = self._pending_way_out, None
            if isinstance(inputs.way_out, Refusal):
                ways.answered(query.start_time, inputs.way_out.message)
            else:
                ways.answered(query.start_time, "")
                if ways is self._running.ways_out:
                    outputs.way_out, outputs.trajectory_id = inputs.way_out, self._flown_id
        if self._goal.replan:
            self._replan(inputs, outputs)
        if self._pending_way_out is None:
            next_query = self._running.way_out(inputs.time, self._goal, self.settings)
            if next_query is not None:
                self._pending_way_out, outputs.way_out_query = (next_query, self._running.ways_out), next_query

    def _replan(self, inputs: Inputs, outputs: Outputs) -> None:
        """Re-plan from a future state of the running plan to the target as seen at present (M's future work)."""
        if inputs.plan is not None:
            self._replan_pending = False
        accepted = self._running.accepted(inputs.plan, inputs.time, self.settings)
        if accepted is not None:
            if accepted is not self._running:
                self._fly_new_plan(accepted, outputs)
                outputs.way_out = None  # of the plan before
            return
        if self._replan_pending:
            return
        start = inputs.time + self.settings.lead(self.latency)
        next_query = self._running.query(inputs.time, self._usable_now(inputs)[0], self._goal, self.settings, start, self.latency)
        if next_query is not None:
            (self._running, outputs.query), self._replan_pending = next_query, True

    def on_no_contact(self, outputs: Outputs) -> None:
        """Command a hover: the trajectory ends at the contact."""
        outputs.commands.append((Command.HOVER, "no adhesion"))
