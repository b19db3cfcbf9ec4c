"""A perch: plan, fly, verify, and rest with the motors off. [M:II, Fig. 2]"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator
from typing import Generic, Protocol, TypeVar

import numpy as np

from perch_control.mission.machine import ACCEPTANCE_TIMEOUT, MissionMachine
from perch_control.mission.moves import LEAD, Moves
from perch_control.mission.settings import MissionSettings
from perch_control.mission.values import Command, ControllerState, Inputs, Outputs, Phase, Plan, PlanQuery, Refusal, Result, Target
from perch_control.mission.ways_out import WaysOut

REPLACED_TIMEOUT = 0.1    # a plan that is still flown so long after its successor's start has not been replaced [s]
ATTACHED_RETRY = 0.1      # period of the command ATTACHED while the controller still flies although the vehicle is attached [s]
_IN_FLIGHT = (ControllerState.TRACKING, ControllerState.HOVERING, ControllerState.RECOVERING)


class InFlight(Protocol):
    """A plan in flight, the target that it was made for, and the ways out of it."""

    @property
    def plan(self) -> Plan: ...

    @property
    def target(self) -> Target: ...

    @property
    def ways_out(self) -> WaysOut: ...


R = TypeVar("R", bound=InFlight)


class PerchingMission(MissionMachine, Generic[R]):
    """Common part of perches on surfaces and on wires. R: type of the plan in flight."""

    _target: Target           # from the query on
    _running: R               # from the first trajectory on
    _others: dict[int, R]     # plans of this attempt that were sent to the controller, other than the running one, by id
    _given_up = 0             # plans up to this id are not awaited any more
    _first_id: int            # of an attempt's first trajectory; ids grow
    _first_start: float       # when that starts [s]
    _attached_sent_at: float  # time of the last command ATTACHED [s]
    _stopped_at: np.ndarray | None = None  # where the motors stopped [m], shape (3,)
    _detached = False         # the vehicle came off after the motors had stopped

    def __init__(self, settings: MissionSettings, ids: Iterator[int] | None = None, moves: Moves | None = None) -> None:
        super().__init__(settings, ids, moves)
        self.phases |= {Phase.PLANNING: self._planning, Phase.TRACKING: self._tracking, Phase.VERIFYING: self._verifying,
                        Phase.PERCHED: self._perched}

    # -- defined by subclasses ---------------------------------------------------------------------------------------

    @property
    @abstractmethod
    def latency(self) -> float:
        """Time from the request of a plan from a hover to its use [s]."""

    @abstractmethod
    def running(self, plan: Plan, target: Target) -> R:
        """Return a plan and its target as a plan in flight."""

    @abstractmethod
    def update_plan(self, inputs: Inputs, outputs: Outputs) -> None:
        """Update the running plan as the target estimate improves, and request new plans and ways out."""

    def contact_awaited(self, inputs: Inputs, outputs: Outputs) -> bool:
        """Whether the contact is still awaited."""
        return inputs.time <= self._running.plan.end + self.settings.contact_time + 0.2

    def committed(self, time: float) -> str:
        """As in the base class; ways out end shortly before the contact, or where the planner finds none."""
        return self._running.ways_out.committed(time) if self.phase in (Phase.TRACKING, Phase.VERIFYING) else ""

    def on_no_contact(self, outputs: Outputs) -> None:
        """Act on a contact that was not detected."""

    def holds(self, inputs: Inputs) -> bool:
        """Whether an abandoned perch holds the vehicle after all, as the contact or the abort was late; never after motors were started."""
        return (self._flown_id > 0 and not self._detached and -self.settings.contact_early < inputs.time - self._running.plan.end < 1.0
                and self._adhesion.is_conclusive(inputs.state) and self._adhesion.attached(inputs.state, self._running.target))

    # -- phases ------------------------------------------------------------------------------------------------------

    def at_target(self, inputs: Inputs, outputs: Outputs, target: Target) -> None:
        """Request a plan from the hover."""
        self._target = target
        p, yaw = self._moves.hover
        start = inputs.time + self.settings.lead(self.latency)
        outputs.query = PlanQuery(start, p, np.zeros(3), yaw, target, self._goal, self.latency)
        self._enter(Phase.PLANNING, inputs.time, "planning")

    def _planning(self, inputs: Inputs, outputs: Outputs) -> None:
        if self._handle_fallback(inputs, outputs):
            return
        if inputs.plan is None:
            if self._elapsed(inputs) > self.settings.phase_timeout:
                self._end(outputs, Result.TIMEOUT, f"the planner has not answered within {self.settings.phase_timeout:g} s; hovering")
            return
        if isinstance(inputs.plan, Refusal):
            self._end(outputs, Result.REFUSED, f"planner refused: {inputs.plan.message}")
            return
        plan = inputs.plan if inputs.plan.start_time > inputs.time else inputs.plan.starting(inputs.time + LEAD)  # the hover lasts
        self._fly(self.running(plan, self._target), outputs)
        self._first_id, self._first_start, self._others = self._flown_id, plan.start_time, {}
        self._enter(Phase.TRACKING, inputs.time, f"perching, {plan.duration:.2f} s")

    def _tracking(self, inputs: Inputs, outputs: Outputs) -> None:
        end = self._running.plan.end
        self.time_to_contact = end - inputs.time
        if self._handle_descent(inputs, outputs):
            return
        hovers = inputs.controller is ControllerState.HOVERING
        if inputs.controller is ControllerState.RECOVERING or hovers and inputs.trajectory_id >= self._first_id:
            self._fail_without_retry(inputs, f"perch given up: {inputs.controller_message}")
            return
        if hovers and inputs.time > self._first_start + ACCEPTANCE_TIMEOUT:
            outputs.commands.append((Command.HOVER, "the plan was not accepted"))  # and must not be later
            self._end(outputs, Result.REFUSED, f"the controller has not accepted the plan: {inputs.controller_message}")
            return
        if not hovers:  # a controller that hovers has not begun, or was commanded to stay
            self._return_to_flown_plan(inputs)
            self.update_plan(inputs, outputs)
        if inputs.time > end - self.settings.contact_early:
            self._adhesion.reset()
            self._enter(Phase.VERIFYING, inputs.time, "waiting for contact")

    def _verifying(self, inputs: Inputs, outputs: Outputs) -> None:
        self.time_to_contact = self._running.plan.end - inputs.time
        if self._adhesion.attached(inputs.state, self._running.target):
            self._contact_time = inputs.time
            self._adhesion.reset()
            outputs.commands.append((Command.ATTACHED, "the surface carries the vehicle"))
            self._enter(Phase.PERCHED, inputs.time, "attached, motors off")
        elif self._handle_descent(inputs, outputs):
            pass
        elif inputs.controller in (ControllerState.RECOVERING, ControllerState.HOVERING):
            if inputs.time < self._running.plan.end:
                self._fail_without_retry(inputs, f"perch given up: {inputs.controller_message}")
            else:
                self._fail_attempt(inputs, f"no adhesion: {inputs.controller_message}")
        elif not self.contact_awaited(inputs, outputs):
            self.on_no_contact(outputs)
            self._fail_attempt(inputs, "no adhesion")

    def _perched(self, inputs: Inputs, outputs: Outputs) -> None:
        if self._stopped_at is None:
            self._stopped_at = inputs.state.p_WB
        rested, attached = self._elapsed(inputs) > self.settings.rest_time, inputs.controller is ControllerState.ATTACHED
        if self._adhesion.detached(inputs.state) or rested and attached and not self._adhesion.rests(inputs.state, self._stopped_at):
            self._detached = True
            outputs.commands += [(Command.ARM, "came off the surface"), (Command.HOVER, "came off the surface")]
            self._fail_attempt(inputs, "came off the surface after the motors stopped")
        elif rested and not attached:
            self._end(outputs, Result.TRACKING_LOST, f"the controller is not attached: {inputs.controller_message}")
        elif rested:
            result, message = Result.PERCHED, "perched"
            if self._cancelled:
                result, message = Result.CANCELLED, f"cancelled too late: perched{self._too_late and f' ({self._too_late})'}"
            self._end(outputs, result, message, contact_time=self._contact_time)
        elif (inputs.controller in _IN_FLIGHT and inputs.time - self._attached_sent_at > ATTACHED_RETRY
              and self._adhesion.attached(inputs.state, self._running.target)):
            self._attached_sent_at = inputs.time
            outputs.commands.append((Command.ATTACHED, "repeated"))  # the first command was lost

    def _recovering(self, inputs: Inputs, outputs: Outputs) -> None:
        super()._recovering(inputs, outputs)
        if self._detached and self.phase is Phase.RECOVERING and inputs.controller is ControllerState.ATTACHED:
            outputs.commands.append((Command.ARM, "came off the surface"))  # the command before was lost, or refused for a moment

    def _enter(self, phase: Phase, time: float, message: str) -> None:
        super()._enter(phase, time, message)
        self._detached = self._detached and phase is Phase.RECOVERING
        if phase is Phase.PERCHED:  # however the goal ends, this is what carries the vehicle
            self._attached_sent_at, self._stopped_at = time, None
            self._moves.wire = self._running.target if self._running.target.lines else None

    # -- plans in flight ---------------------------------------------------------------------------------------------

    def _fly(self, running: R, outputs: Outputs) -> None:
        self._running, self._flown_id = running, self._new_id()
        outputs.perch, outputs.trajectory_id = running.plan, self._flown_id

    def _fly_new_plan(self, running: R, outputs: Outputs) -> None:
        self._others[self._flown_id] = self._running
        self._fly(running, outputs)
        self.message = f"re-planned, {running.plan.duration:.2f} s"

    def _return_to_flown_plan(self, inputs: Inputs) -> None:
        """Return to the plan that the controller flies, where it has not accepted the one after it."""
        if inputs.trajectory_id == self._flown_id or inputs.trajectory_id not in self._others:
            return
        plans = self._others | {self._flown_id: self._running}
        awaited = [id for id in plans if id > max(inputs.trajectory_id, self._given_up)]
        if not awaited or inputs.time > plans[min(awaited)].plan.start_time + REPLACED_TIMEOUT:
            self._others, self._given_up = plans, max(plans)
            self._flown_id, self._running = inputs.trajectory_id, plans[inputs.trajectory_id]
            self.message = f"the new plan was not accepted: {inputs.controller_message}"
