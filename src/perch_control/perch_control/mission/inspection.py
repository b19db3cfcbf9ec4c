"""An inspection of a powerline along the mission's waypoints; the controller's line terms keep the line in view. [P:VI-A]"""

from __future__ import annotations

from collections.abc import Iterator

from perch_core.values import PerchGoal
from perch_control.mission.machine import ACCEPTANCE_TIMEOUT
from perch_control.mission.moves import LEAD, Moves
from perch_control.mission.settings import MissionSettings
from perch_control.mission.values import Command, ControllerState, Goal, Inputs, Outputs, Phase, Result, Target
from perch_control.mission.waypoints import waypoint_lines
from perch_control.mission.wire import LineMission


class InspectionMission(LineMission):
    """Find the line, fly the waypoints, end in a hover."""

    def __init__(self, settings: MissionSettings, ids: Iterator[int] | None = None, moves: Moves | None = None) -> None:
        super().__init__(settings, ids, moves)
        self.phases[Phase.INSPECTING] = self._inspecting
        self._inspected = 0.0  # when the last waypoint is due [s]

    @classmethod
    def problem(cls, goal: PerchGoal, settings: MissionSettings) -> str:
        """As for all missions; in addition, at least two waypoints are required."""
        if len(settings.places) < 2:
            return f"inspection: the parameter mission.waypoints holds {len(settings.places)} waypoints, needs at least 2"
        return super().problem(goal, settings)

    def start(self, goal: Goal, time: float) -> None:
        """Start a goal with the waypoints of now: later changes are for the next goal."""
        super().start(goal, time)
        self._places = self.settings.places

    def at_target(self, inputs: Inputs, outputs: Outputs, target: Target) -> None:
        """Fly from the hover along the waypoints; the controller's line terms keep the line in view and avoid all lines."""
        places = [self._moves.hover, *self._places]
        outputs.reference = waypoint_lines(places, self.settings.inspection_speed, inputs.time + LEAD)
        outputs.trajectory_id = self._flown_id = self._new_id()
        self._inspected = inputs.time + LEAD + outputs.reference.duration
        self._enter(Phase.INSPECTING, inputs.time, f"inspecting, {outputs.reference.duration:.1f} s")

    def _handle_wrong_place(self, inputs: Inputs) -> bool:
        """Return False: the controller's line terms may hold the vehicle away from the search place."""
        return False

    def _inspecting(self, inputs: Inputs, outputs: Outputs) -> None:
        if self._handle_fallback(inputs, outputs):
            return
        hovers = inputs.controller is ControllerState.HOVERING
        if hovers and inputs.trajectory_id == self._flown_id:
            if inputs.time < self._inspected:
                self._fail_attempt(inputs, f"inspection given up: {inputs.controller_message}")
            else:
                self._end(outputs, Result.PERCHED, f"inspected along {len(self._places)} waypoints")
        elif hovers and inputs.time > self.since + LEAD + ACCEPTANCE_TIMEOUT:
            outputs.commands.append((Command.HOVER, "the inspection was not accepted"))  # and must not be later
            self._end(outputs, Result.REFUSED, f"the controller has not accepted the inspection: {inputs.controller_message}")
        elif inputs.time > self._inspected + self.settings.arming_timeout:
            outputs.commands.append((Command.HOVER, "the inspection does not end"))
            self._fail_attempt(inputs, f"the inspection does not end: {inputs.controller_message}")
