"""A perch on an inclined surface, marked by a board of tags. [M]"""

from __future__ import annotations

from perch_control.mission.perching import PerchingMission
from perch_control.mission.running_perch import RunningPerch
from perch_control.mission.values import Command, Inputs, Outputs, Plan, Target


class SurfaceMission(PerchingMission[RunningPerch]):
    """Find the pad, plan, perch; where asked, plan again to the pad as it is seen nearer."""

    unseen = "no tags seen"

    @property
    def latency(self) -> float:
        """Of a plan for a surface, from a hover or in flight [s]."""
        return self.settings.planner_latency

    def running(self, plan: Plan, target: Target) -> RunningPerch:
        """A plan in flight."""
        return RunningPerch(plan, target, target)

    def better(self, inputs: Inputs, outputs: Outputs) -> None:
        """Refine the target in flight and continue from the running plan's future (M's future work)."""
        if not self._goal.replan:
            return
        better = self._running.better(inputs.plan, inputs.time, self.settings)
        if better is not None:
            if better is not self._running:
                self._fly_better(better, outputs)
            return
        start = inputs.time + self.settings.lead(self.latency)
        asked = self._running.query(inputs.time, self._usable_now(inputs)[0], self._goal, self.settings, start, self.latency)
        if asked is not None:
            self._running, outputs.query = asked

    def not_held(self, outputs: Outputs) -> None:
        """Stop: the trajectory has no way on."""
        outputs.commands.append((Command.HOVER, "no adhesion"))
