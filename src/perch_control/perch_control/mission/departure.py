"""Departure from the surface or wire that carries the vehicle, to a hover from which the next goal can start."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from perch_core.trajectory import StateSample
from perch_control.mission.machine import MissionMachine
from perch_control.mission.moves import LEAD, Moves
from perch_control.mission.settings import MissionSettings
from perch_control.mission.values import (
    Command, ControllerState, Inputs, Outputs, Phase, Plan, PlanQuery, Refusal, Result, Target)

ANSWER_TIMEOUT = 5.0  # for the planner's answer, beyond its latency [s]
DEPARTURE_ACCEPTANCE_TIMEOUT = 1.0  # a controller that is still attached so long after a plan's start has not accepted it [s]
_THRUST = 0.5  # of each rotor, soon after its start [N]


class Departure(MissionMachine):
    """Departure by a recovery: from a wire that of the planner [P:V-B], planned from the vehicle at rest; from a surface, or
    without a plan that is flown, that of the controller, along the surface's normal. Either starts the motors, which releases the
    attachment.
    """

    _no_plan = False  # the planner or the controller has refused, or has not reacted until `_due`
    _due: float       # from the query on [s]

    def __init__(self, settings: MissionSettings, ids: Iterator[int] | None = None, moves: Moves | None = None) -> None:
        super().__init__(settings, ids, moves)
        self.phases = {Phase.ARMING: self._leaving, Phase.RECOVERING: self._recovering}

    def at_target(self, inputs: Inputs, outputs: Outputs, target: Target) -> None:
        """Do nothing: a departure has no target."""

    def _leaving(self, inputs: Inputs, outputs: Outputs) -> None:
        if inputs.plan is not None and not self._no_plan:
            self._fly(inputs, outputs, inputs.plan)
        elif inputs.controller in (ControllerState.RECOVERING, ControllerState.HOVERING) and self._requested_at is not None:
            self._fail_attempt(inputs, "departing")
        elif inputs.controller is ControllerState.TRACKING and self._requested_at is not None:
            pass
        elif self._requested_at is not None and self._handle_descent(inputs, outputs):
            pass
        elif inputs.controller is not ControllerState.ATTACHED and inputs.controller_time > -np.inf:
            self._end(outputs, Result.REFUSED, f"not perched: the controller is {inputs.controller.name.lower()}")
        elif self._elapsed(inputs) > self.settings.phase_timeout:
            why = inputs.controller_message if inputs.estimator_ready else "the estimator is not ready"
            self._end(outputs, Result.TIMEOUT, f"no departure within {self.settings.phase_timeout:g} s: {why}")
        elif inputs.controller_time == -np.inf:
            self.message = "waiting for the controller"
        elif inputs.estimator_ready and not self._no_plan and (wire := self._moves.wire) is not None:
            if self._requested_at is None:
                self._requested_at, outputs.query = inputs.time, self._way_out(inputs, wire)
                self._due = inputs.time + self.settings.powerline_latency + ANSWER_TIMEOUT
            elif inputs.time > self._due:
                silent = f"the controller has not accepted it: {inputs.controller_message}" if self._flown_id else "the planner has not answered"
                self._leave_without_plan(inputs, outputs, silent)
        elif inputs.estimator_ready and self._should_request_arm(inputs):
            outputs.commands.append((Command.ARM, "departing"))

    def _way_out(self, inputs: Inputs, wire: Target) -> PlanQuery:
        """Return the query for the recovery, from the vehicle at rest on the wire."""
        zero, x, latency = np.zeros(3), inputs.state, self.settings.powerline_latency
        start = inputs.time + self.settings.lead(latency)
        still = StateSample(p=x.p_WB, q=x.q_WB, v=zero, w=zero, a=zero, dw=zero, rotor_thrust=np.full(4, _THRUST))
        return PlanQuery(start, x.p_WB, zero, 0.0, wire, self._goal, latency, state=still, recovery=True)

    def _fly(self, inputs: Inputs, outputs: Outputs, plan: Plan | Refusal) -> None:
        """Fly the plan at once."""
        if isinstance(plan, Refusal):
            self._leave_without_plan(inputs, outputs, plan.message)
            return
        self._flown_id, self._due = self._new_id(), inputs.time + LEAD + DEPARTURE_ACCEPTANCE_TIMEOUT
        outputs.perch, outputs.trajectory_id = plan.starting(inputs.time + LEAD), self._flown_id

    def _leave_without_plan(self, inputs: Inputs, outputs: Outputs, why: str) -> None:
        """Arm for the controller's own recovery."""
        self.message = f"no plan to leave the wire: {why}"
        outputs.commands.append((Command.ARM, "departing"))
        self._no_plan, self._requested_at = True, inputs.time

    def _recovered(self, inputs: Inputs, outputs: Outputs) -> None:
        self._end(outputs, Result.PERCHED, "departed; hovering")
