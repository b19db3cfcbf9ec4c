"""A perch on a mapped powerline, upside down or not. [P]"""

from __future__ import annotations

import numpy as np

from perch_core.values import PowerlineMap
from perch_control.mission.line_target import mapped_target
from perch_control.mission.machine import MissionMachine
from perch_control.mission.moves import SearchPlace
from perch_control.mission.perching import PerchingMission
from perch_control.mission.running_plan import RunningPlan
from perch_control.mission.values import Inputs, Outputs, Plan, Target

MAPPING_REACH = 0.8  # how far the vehicle moves up to see lines from other places [m]
MAPPING_LEGS = 3     # moves of the pattern before a plan: up, nearer, down; perches begin from the near place


class LineMission(MissionMachine):
    """Mission at a mapped powerline: the lines are observed from several places."""

    no_target_message = "no line mapped near the goal's point, or a vertical one"
    target_channel = "powerlines"

    def target(self, pad: Target | None, lines: PowerlineMap | None, p_WB: np.ndarray) -> Target | None:
        """Return the target on the mapped line that the goal refers to."""
        return None if lines is None else mapped_target(lines, self._goal, p_WB)

    def pattern(self) -> list[SearchPlace]:
        """Places to observe the lines from: up, closer (the error of a distance grows with its square), down, back, and aside."""
        reach, near = MAPPING_REACH, self.settings.mapping_approach
        return [(np.array(v), 0.0) for v in ((0, 0, reach), (near, 0, reach), (near, 0, 0), (0, 0, 0), (0, reach / 2, 0))]


class PowerlineMission(LineMission, PerchingMission[RunningPlan]):
    """Map the lines, plan a perch with its recovery, fly it with ways out kept ready."""

    @property
    def legs(self) -> int:
        """Number of moves of the pattern that are flown before any plan."""
        return MAPPING_LEGS

    def reach(self, offset: np.ndarray, p: np.ndarray, target: Target | None) -> np.ndarray:
        """As in the base class; a move towards the lines stays at least `mapping_standoff` away from the target."""
        if not offset[0] > 0.0:
            return offset
        room = 0.0 if target is None else float(np.linalg.norm(target.p_WS - p)) - self.settings.mapping_standoff
        return np.array([min(offset[0], max(room, 0.0)), *offset[1:]])

    @property
    def latency(self) -> float:
        """Latency of a plan from a hover [s]."""
        return self.settings.powerline_latency

    def running(self, plan: Plan, target: Target) -> RunningPlan:
        """Return a plan and its target as a plan in flight."""
        return RunningPlan.from_plan(plan, target, self.settings)

    def update_plan(self, inputs: Inputs, outputs: Outputs) -> None:
        """Update the plan as the map improves, and keep a way out ready."""
        if inputs.plan is not None:
            outputs.way_out, new = self._running.answered(inputs.plan, inputs.time)
            outputs.trajectory_id = self._flown_id
            if new is not None:
                self._fly_new_plan(new, outputs)
        target, _ = self._usable_now(inputs)
        shifted = self._running.shifted(inputs.time, target, self._goal)
        if shifted is not None and outputs.perch is None and outputs.way_out is None:
            self._running = shifted
            outputs.perch, outputs.trajectory_id = shifted.plan, self._flown_id
        outputs.query = self._running.query(inputs.time, inputs.state, target, self._goal)

    def cancelled_too_late(self, inputs: Inputs, outputs: Outputs) -> None:
        """As in the base class; but a hover is commanded, too: the plan's own recovery leads to it where the gripper fails."""
        self._cancel_to_hover(inputs, outputs)
        self.message = f"cancelled too late, unless the gripper fails: {self._too_late}"

    def contact_awaited(self, inputs: Inputs, outputs: Outputs) -> bool:
        """Whether the contact is still awaited. Ways out are requested until the plan continues into its own recovery."""
        if inputs.time <= self._running.plan.end + self.settings.contact_time:
            self.update_plan(inputs, outputs)
            return True
        return super().contact_awaited(inputs, outputs)
