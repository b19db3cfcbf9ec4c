"""The mission's state machine: one method per phase, called once per tick."""

from __future__ import annotations

import numpy as np

from perch_control.mission.adhesion import AdhesionMonitor
from perch_control.mission.moves import LEAD, Moves, Place, place_of
from perch_control.mission.running_perch import RunningPerch
from perch_control.mission.running_plan import RunningPlan
from perch_control.mission.settings import MissionSettings
from perch_control.mission.usable_target import usable
from perch_control.mission.values import (
    Command, ControllerState, Goal, Inputs, Mode, Outcome, Outputs, Phase, PlanQuery, Result, Target)
from perch_control.mission.waypoints import waypoint_lines

_FLYING = (ControllerState.TRACKING, ControllerState.HOVERING)


class MissionMachine:
    """Find the target, plan, fly, perch, verify; recover when it fails. [M:II, Fig. 2]

    `tick` maps what is known to what shall be done. Every phase ends in another phase, in an outcome, or by its own
    time limit, so that a goal always ends; a cancelled or failed goal ends in a hover, or on the ground.
    """

    def __init__(self, settings: MissionSettings) -> None:
        self.settings = settings
        self.phase = Phase.IDLE
        self.message = ""
        self.time_to_contact = float("nan")
        self._adhesion = AdhesionMonitor(settings.adhesion)
        self._goal: Goal | None = None
        self._next_id = 1

    # -- interface ---------------------------------------------------------------------------------------------------

    def start(self, goal: Goal, time: float) -> None:
        """Take a goal; the machine must be idle."""
        self._goal, self._attempts_left = goal, goal.attempts
        self._failure: str | None = None
        self._moves = Moves(self.settings)
        self._running: RunningPerch | RunningPlan | None = None
        self._perch_id = 0
        self._contact_time = float("nan")
        self._cancelled = False
        self._enter(Phase.ARMING, time, "waiting for the estimator")

    def tick(self, inputs: Inputs) -> Outputs:
        """Advance by one tick."""
        outputs = Outputs()
        self._adhesion.add(inputs.specific_force_B)
        self.time_to_contact = float("nan")
        if self.phase is Phase.IDLE:
            return outputs
        if inputs.cancel and not self._cancelled:
            self._cancel(inputs, outputs)
        elif inputs.controller is ControllerState.FAILED and self.phase is not Phase.PERCHED:
            self._end(outputs, Result.TRACKING_LOST, f"controller gave up: {inputs.controller_message}")
        else:
            getattr(self, f"_{self.phase.value}")(inputs, outputs)
        return outputs

    # -- phases ------------------------------------------------------------------------------------------------------

    def _arming(self, inputs: Inputs, outputs: Outputs) -> None:
        if inputs.controller in _FLYING:
            self._moves.hover = place_of(inputs.state)
            self._enter(Phase.TAKE_OFF, inputs.time, "already flying: going to the search place")
            self._go(inputs, outputs, self._moves.search_place(self._goal, inputs.state))
        elif inputs.controller is ControllerState.ARMED:
            self._moves.hover = place_of(inputs.state)
            self._enter(Phase.TAKE_OFF, inputs.time, "taking off")
            self._go(inputs, outputs, self._moves.search_place(self._goal, inputs.state))
        elif self._elapsed(inputs) > self.settings.arming_timeout:
            outputs.commands.append((Command.DISARM, "arming took too long"))
            why = "the estimator is not ready" if not inputs.estimator_ready else inputs.controller_message
            self._end(outputs, Result.TIMEOUT, f"not armed within {self.settings.arming_timeout:g} s: {why}")
        elif inputs.estimator_ready and not self._asked:
            outputs.commands.append((Command.ARM, "goal accepted"))
            self._asked, self.message = True, "arming"

    def _take_off(self, inputs: Inputs, outputs: Outputs) -> None:
        if self._lost(inputs, outputs):
            return
        if self._moves.arrived(inputs.time, inputs.state):
            self._enter(Phase.SEARCHING, inputs.time, "looking for the target")

    def _searching(self, inputs: Inputs, outputs: Outputs) -> None:
        if self._lost(inputs, outputs):
            return
        target = inputs.target
        good, why = usable(target, self._entered_search, self._goal, self.settings)
        if self._goal.mode is Mode.POWERLINE and self._moves.looked < self.settings.mapping_legs:
            if self._moves.arrived(inputs.time, inputs.state):
                self._go_on_looking(inputs, outputs, "mapping the lines")
            return
        if good:
            if self._seen_since is None:
                self._seen_since = inputs.time
                self.message = "target in view"
            if inputs.time - self._seen_since >= self.settings.target_settle and self._moves.arrived(inputs.time, inputs.state):
                if self._goal.mode is Mode.INSPECTION:
                    self._inspect(inputs, outputs)
                else:
                    self._ask_plan(inputs, outputs, target)
            return
        if self._elapsed(inputs) > self._goal.search_timeout:
            self._end(outputs, Result.NOT_FOUND, f"no target within {self._goal.search_timeout:g} s: {why}")
            return
        if self._moves.arrived(inputs.time, inputs.state) and self._moves.dwelt(inputs.time):
            self._go_on_looking(inputs, outputs, f"looking for the target ({why})")

    def _go_on_looking(self, inputs: Inputs, outputs: Outputs, message: str) -> None:
        """Fly to the next place of the pattern."""
        self._go(inputs, outputs, self._moves.next_look(self._goal, inputs.state, inputs.target))
        self.message = message

    def _planning(self, inputs: Inputs, outputs: Outputs) -> None:
        if self._lost(inputs, outputs):
            return
        if inputs.plan is None:
            return
        if not inputs.plan.success:
            self._end(outputs, Result.REFUSED, f"planner refused: {inputs.plan.message}")
            return
        if self._goal.mode is Mode.POWERLINE:
            self._fly(RunningPlan(inputs.plan, self._target, self.settings), outputs)
        else:
            self._fly(RunningPerch(inputs.plan, self._target, self._target), outputs)
        self._enter(Phase.TRACKING, inputs.time, f"perching, {inputs.plan.duration:.2f} s")

    def _tracking(self, inputs: Inputs, outputs: Outputs) -> None:
        end = self._running.end
        self.time_to_contact = end - inputs.time
        if inputs.trajectory_id == self._perch_id and inputs.controller in (ControllerState.RECOVERING, ControllerState.HOVERING):
            self._missed(inputs, f"perch given up: {inputs.controller_message}")
            return
        if self._goal.mode is Mode.POWERLINE:
            self._look_ahead(inputs, outputs)
        elif self._goal.replan:
            self._replan(inputs, outputs)
        if inputs.time > end - self.settings.contact_early:
            self._adhesion.reset()
            self._enter(Phase.VERIFYING, inputs.time, "waiting for contact")

    def _verifying(self, inputs: Inputs, outputs: Outputs) -> None:
        end = self._running.end
        self.time_to_contact = end - inputs.time
        if self._adhesion.attached(inputs.state, self._running.target):
            self._contact_time = inputs.time
            self._adhesion.reset()
            outputs.commands.append((Command.ATTACHED, "the surface carries the vehicle"))
            self._enter(Phase.PERCHED, inputs.time, "attached, motors off")
        elif inputs.controller in (ControllerState.RECOVERING, ControllerState.HOVERING):
            self._missed(inputs, f"no adhesion: {inputs.controller_message}")
        elif self._goal.mode is Mode.POWERLINE and inputs.time <= end + self.settings.contact_time:
            self._look_ahead(inputs, outputs)
        elif inputs.time > end + self.settings.contact_time + 0.2:
            if self._goal.mode is Mode.SURFACE:  # a powerline plan goes on into its recovery by itself
                outputs.commands.append((Command.HOVER, "no adhesion"))
            self._missed(inputs, "no adhesion")

    def _inspect(self, inputs: Inputs, outputs: Outputs) -> None:
        """From the present hover along the waypoints; the controller's line terms keep the line in view and all lines away."""
        places = [self._moves.hover, *self.settings.places]
        outputs.reference = waypoint_lines(places, self.settings.inspection_speed, inputs.time + LEAD)
        outputs.trajectory_id = self._perch_id = self._new_id()
        self._inspected = inputs.time + LEAD + outputs.reference.duration
        self._enter(Phase.INSPECTING, inputs.time, f"inspecting, {outputs.reference.duration:.1f} s")

    def _inspecting(self, inputs: Inputs, outputs: Outputs) -> None:
        if self._lost(inputs, outputs):
            return
        if inputs.trajectory_id == self._perch_id and inputs.controller is ControllerState.HOVERING:
            if inputs.time < self._inspected:
                self._missed(inputs, f"inspection given up: {inputs.controller_message}")
            else:
                self._end(outputs, Result.PERCHED, f"inspected along {len(self.settings.places)} waypoints")
        elif inputs.time > self._inspected + self.settings.arming_timeout:
            outputs.commands.append((Command.HOVER, "the inspection does not end"))
            self._missed(inputs, f"the inspection does not end: {inputs.controller_message}")

    def _perched(self, inputs: Inputs, outputs: Outputs) -> None:
        if self._adhesion.free_fall():
            outputs.commands.append((Command.ARM, "came off the surface"))
            outputs.commands.append((Command.HOVER, "came off the surface"))
            self._missed(inputs, "came off the surface after the motors stopped")
        elif self._elapsed(inputs) > self.settings.rest_time:
            result, words = (Result.CANCELLED, "cancelled too late: ") if self._cancelled else (Result.PERCHED, "")
            self._end(outputs, result, f"{words}perched", contact_time=self._contact_time)

    def _recovering(self, inputs: Inputs, outputs: Outputs) -> None:
        resting = inputs.controller is ControllerState.HOVERING and self._moves.slow(inputs.state)
        if self._gripped(inputs):
            self._contact_time = inputs.time
            outputs.commands.append((Command.ATTACHED, "the gripper has closed all the same"))
            self._enter(Phase.PERCHED, inputs.time, "attached, motors off")
            return
        if inputs.controller in (ControllerState.DISARMED, ControllerState.LANDING):
            self._end(outputs, Result.CANCELLED if self._cancelled else Result.CRASHED, f"{self._failure}; on the ground or descending")
        elif self._elapsed(inputs) > self.settings.phase_timeout:
            outputs.commands.append((Command.LAND, "recovery took too long"))
            self._end(outputs, Result.TRACKING_LOST, f"{self._failure}; no hover within {self.settings.phase_timeout:g} s, landing")
        elif resting and self._elapsed(inputs) > self.settings.settle_time:
            self._attempts_left -= 1
            if self._cancelled:
                self._end(outputs, Result.CANCELLED, "cancelled; hovering")
            elif self._attempts_left > 0:
                self._moves.hover = place_of(inputs.state)
                self._enter(Phase.TAKE_OFF, inputs.time, f"{self._failure}; {self._attempts_left} attempts left")
                self._go(inputs, outputs, self._moves.search_place(self._goal, inputs.state))
            else:
                self._end(outputs, Result.MISSED, f"{self._failure}; recovered to a hover")

    def _gripped(self, inputs: Inputs) -> bool:
        """An abort came so late that the vehicle passed the wire on its way out, and holds it."""
        return (isinstance(self._running, RunningPlan) and -self.settings.contact_early < inputs.time - self._running.end < 1.0
                and self._adhesion.attached(inputs.state, self._running.target))

    # -- planning ----------------------------------------------------------------------------------------------------

    def _ask_plan(self, inputs: Inputs, outputs: Outputs, target: Target) -> None:
        self._target = target
        latency, lead = self.settings.planning_times(self._goal.mode)
        zero = np.zeros(3)
        p, yaw = self._moves.hover
        outputs.query = PlanQuery(inputs.time + lead, p, zero, zero, zero, yaw, target, self._goal, latency)
        self._enter(Phase.PLANNING, inputs.time, "planning")

    def _replan(self, inputs: Inputs, outputs: Outputs) -> None:
        """Refine the target in flight and continue from the running plan's future (M's future work)."""
        better = self._running.better(inputs.plan, inputs.time, self.settings)
        if better is not None:
            if better is not self._running:
                self._fly_better(better, outputs)
            return
        latency, lead = self.settings.planning_times(self._goal.mode)
        asked = self._running.query(inputs.time, self._usable_now(inputs), self._goal, self.settings, inputs.time + lead, latency)
        if asked is not None:
            self._running, outputs.query = asked

    def _look_ahead(self, inputs: Inputs, outputs: Outputs) -> None:
        """On the way to a wire: follow the map as it gets better, and keep a way out ready."""
        if inputs.plan is not None:
            outputs.way_out, better = self._running.answered(inputs.plan, inputs.time)
            outputs.trajectory_id = self._perch_id
            if better is not None:
                self._fly_better(better, outputs)
        target = self._usable_now(inputs)
        moved = self._running.moved(inputs.time, target, self._goal)
        if moved is not None and outputs.perch is None and outputs.way_out is None:
            self._running = moved
            outputs.perch, outputs.trajectory_id = moved.plan, self._perch_id
        outputs.query = self._running.query(inputs.time, inputs.state, target, self._goal)

    def _fly(self, running: RunningPerch | RunningPlan, outputs: Outputs) -> None:
        self._running, self._perch_id = running, self._new_id()
        outputs.perch, outputs.trajectory_id = running.plan, self._perch_id

    def _fly_better(self, better: RunningPerch | RunningPlan, outputs: Outputs) -> None:
        self._fly(better, outputs)
        self.message = f"re-planned, {better.plan.duration:.2f} s"

    def _usable_now(self, inputs: Inputs) -> Target | None:
        """The target, where it is fresh and certain enough to plan on."""
        return inputs.target if usable(inputs.target, self._entered_search, self._goal, self.settings)[0] else None

    def _go(self, inputs: Inputs, outputs: Outputs, place: Place) -> None:
        outputs.reference, outputs.trajectory_id = self._moves.go(inputs.time, place), self._new_id()

    # -- endings -----------------------------------------------------------------------------------------------------

    def _lost(self, inputs: Inputs, outputs: Outputs) -> bool:
        """The controller fell back to recovery or descent while the mission was waiting in flight."""
        if inputs.controller is ControllerState.RECOVERING:
            self._attempts_left = 1
            self._missed(inputs, f"controller recovers: {inputs.controller_message}")
            return True
        if inputs.controller in (ControllerState.LANDING, ControllerState.DISARMED):
            self._end(outputs, Result.TRACKING_LOST, f"controller descends: {inputs.controller_message}")
            return True
        if self.phase is Phase.TAKE_OFF and self._elapsed(inputs) > self.settings.phase_timeout:
            outputs.commands.append((Command.LAND, "take-off took too long"))
            self._end(outputs, Result.TIMEOUT, f"search hover not reached within {self.settings.phase_timeout:g} s; landing")
            return True
        return False

    def _missed(self, inputs: Inputs, why: str) -> None:
        self._failure = why
        self._enter(Phase.RECOVERING, inputs.time, why)

    def _cancel(self, inputs: Inputs, outputs: Outputs) -> None:
        self._cancelled = True
        if self.phase is Phase.PERCHED:
            self._end(outputs, Result.CANCELLED, "cancelled; attached with motors off")
        elif inputs.controller in (ControllerState.DISARMED, ControllerState.ARMED):
            outputs.commands.append((Command.DISARM, "cancelled"))
            self._end(outputs, Result.CANCELLED, "cancelled on the ground")
        else:
            outputs.commands.append((Command.HOVER, "cancelled"))
            self._missed(inputs, "cancelled")

    def _end(self, outputs: Outputs, result: Result, message: str, contact_time: float = float("nan")) -> None:
        outputs.outcome = Outcome(result, message, contact_time)
        self.phase, self.message, self._goal = Phase.IDLE, message, None

    def _enter(self, phase: Phase, time: float, message: str) -> None:
        self.phase, self.message, self._since = phase, message, time
        if phase is Phase.ARMING:
            self._asked, self._entered_search = False, time
        if phase is Phase.SEARCHING:
            self._seen_since, self._moves.looked, self._entered_search = None, 0, time

    def _elapsed(self, inputs: Inputs) -> float:
        return inputs.time - self._since

    def _new_id(self) -> int:
        self._next_id += 1
        return self._next_id - 1
