"""Common part of all missions: arm, take off, search, recover, end. Subclasses define the action at the target."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from itertools import count

import numpy as np

from perch_core.values import PerchGoal, PowerlineMap
from perch_control.mission.adhesion import AdhesionMonitor
from perch_control.mission.moves import Moves, Place, SearchPlace
from perch_control.mission.settings import MissionSettings
from perch_control.mission.usable_target import unusable_reason
from perch_control.mission.values import Command, ControllerState, Goal, Inputs, Outcome, Outputs, Phase, Result, Target

SEARCH_RISE = 0.25              # height change of the search pattern [m]
SEARCH_TURN = np.radians(30.0)  # its sweep [rad]
ACCEPTANCE_TIMEOUT = 0.5  # a controller that still hovers so long after a trajectory's start has not accepted it [s]


class MissionMachine(ABC):
    """One goal, from arming to its outcome. [M:II, Fig. 2]

    `tick` maps inputs to outputs. Every phase ends in another phase, in an outcome, or by its own time limit, so that a goal
    always ends; a cancelled or failed goal ends in a hover, or on the ground.

    A subclass defines its target (`target`), the search for it (`pattern`, `legs`), and the action once the target has been seen
    and the vehicle rests (`at_target`); it adds its own phases to `phases`.

    Attributes:
        phase, message, time_to_contact: as in the feedback.
        since: when the phase began [s].
        phases: handler of each phase.
    """

    _goal: Goal  # from `start` on
    no_target_message = "no target detected"
    """Message while no target is detected."""
    target_channel = "target/pose"
    """Channel of the target: this one, or `powerlines`."""

    def __init__(self, settings: MissionSettings, ids: Iterator[int] | None = None, moves: Moves | None = None) -> None:
        """
        Args:
            settings: times, speeds, limits.
            ids: ids of the following trajectories; never repeated for one controller.
            moves: moves of the preceding goals; None: this is the first goal.
        """
        self.settings = settings
        self.phase = Phase.IDLE
        self.message = ""
        self.time_to_contact = float("nan")
        self.phases: dict[Phase, Callable[[Inputs, Outputs], None]] = {
            Phase.ARMING: self._arming, Phase.TAKE_OFF: self._take_off, Phase.SEARCHING: self._searching,
            Phase.RECOVERING: self._recovering}
        self._adhesion = AdhesionMonitor()
        self.since = self._entered_search = 0.0
        self._target_since: float | None = None
        self._requested_at: float | None = None  # when arming, or a way out from a wire, was requested last [s]
        self._ids = count(1) if ids is None else ids
        self._moves = Moves(settings) if moves is None else moves

    # -- defined by subclasses ---------------------------------------------------------------------------------------

    @property
    def legs(self) -> int:
        """Number of places of the pattern that are visited before a target is used."""
        return 0

    @classmethod
    def problem(cls, goal: PerchGoal, settings: MissionSettings) -> str:
        """Return why a goal cannot be flown, beyond the checks for all missions; empty: it can."""
        return ""

    def target(self, pad: Target | None, lines: PowerlineMap | None, p_WB: np.ndarray) -> Target | None:
        """Return the target of this mission from the available sightings.

        Args:
            pad: last localised pad.
            lines: the newest map.
            p_WB: position of the vehicle [m], shape (3,).
        """
        return pad

    def pattern(self) -> list[SearchPlace]:
        """Places around the search hover (forward, left, up [m], turn [rad]), to find a pad that is out of view."""
        return [(np.array([0.0, 0.0, SEARCH_RISE]), 0.0), (np.zeros(3), SEARCH_TURN), (np.zeros(3), -SEARCH_TURN),
                (np.array([0.0, 0.0, -SEARCH_RISE]), 0.0), (np.zeros(3), 0.0)]

    def reach(self, offset: np.ndarray, p: np.ndarray, target: Target | None) -> np.ndarray:
        """Return the part of an offset of the pattern (forward, left, up [m]) from the search place `p` [m] that is flown."""
        return offset

    @abstractmethod
    def at_target(self, inputs: Inputs, outputs: Outputs, target: Target) -> None:
        """Act once the target has been seen for long enough and the vehicle rests."""

    def committed(self, time: float) -> str:
        """Return why no way out of the running plan is left at a time [s]; empty: there is one, or no plan."""
        return ""

    def cancelled_too_late(self, inputs: Inputs, outputs: Outputs) -> None:
        """Act on a cancellation when no way out of the running plan is left: the plan, which ends at the contact, is flown."""
        self.message = f"cancelled too late: {self._too_late}"

    def holds(self, inputs: Inputs) -> bool:
        """Whether the target holds the vehicle after all, during a recovery."""
        return False

    # -- interface ---------------------------------------------------------------------------------------------------

    def reconfigure(self, settings: MissionSettings) -> None:
        """Apply new settings from the next tick on; the moves of the running goal keep theirs."""
        self.settings = settings

    def start(self, goal: Goal, time: float) -> None:
        """Start a goal; the machine must be idle."""
        self._goal, self._attempts_left = goal, goal.attempts
        self._failure: str | None = None
        self._moves.settings = self.settings
        self._flown_id = 0
        self._contact_time = float("nan")
        self._cancelled, self._too_late = False, ""  # and why it was too late, where the perch was not yet complete
        self._enter(Phase.ARMING, time, "waiting for the estimator")

    def tick(self, inputs: Inputs) -> Outputs:
        """Advance by one tick."""
        outputs = Outputs()
        self._adhesion.add(inputs.specific_force_B, inputs.imu_period)
        self.time_to_contact = float("nan")
        if self.phase is Phase.IDLE:
            return outputs
        if inputs.cancel and not self._cancelled:
            self._cancel(inputs, outputs)
        elif inputs.controller is ControllerState.FAILED and self.phase is not Phase.PERCHED:
            self._end(outputs, Result.TRACKING_LOST, f"controller failed: {inputs.controller_message}")
        else:
            self.phases[self.phase](inputs, outputs)
        return outputs

    # -- phases ------------------------------------------------------------------------------------------------------

    def _arming(self, inputs: Inputs, outputs: Outputs) -> None:
        if inputs.controller is ControllerState.ATTACHED:
            self._end(outputs, Result.PERCHED_ALREADY, "the vehicle is perched; call the service `depart` first")
        elif inputs.controller in (ControllerState.TRACKING, ControllerState.HOVERING) and inputs.estimator_ready:
            self._go_to_search(inputs, outputs, "already flying: going to the search place")
        elif inputs.controller is ControllerState.ARMED and inputs.controller_time > self.since and inputs.estimator_ready:
            self._go_to_search(inputs, outputs, "taking off", on_ground=True)
        elif self._elapsed(inputs) > self.settings.arming_timeout:
            outputs.commands.append((Command.DISARM, "arming took too long"))
            why = "the estimator is not ready" if not inputs.estimator_ready else inputs.controller_message
            self._end(outputs, Result.TIMEOUT, f"not armed within {self.settings.arming_timeout:g} s: {why}")
        elif inputs.estimator_ready and inputs.controller_time == -np.inf:  # it may be attached: ARM would start it from its perch
            self.message = "waiting for the controller"
        elif inputs.estimator_ready and self._should_request_arm(inputs):
            outputs.commands.append((Command.ARM, "goal accepted"))
            self.message = "arming"

    def _should_request_arm(self, inputs: Inputs) -> bool:
        """Whether to send the command to arm, for the first time or again: it may be lost, or refused while odometry is late."""
        if self._requested_at is not None and inputs.time - self._requested_at < self.settings.arm_retry_period:
            return False
        self._requested_at = inputs.time
        return True

    def _take_off(self, inputs: Inputs, outputs: Outputs) -> None:
        if self._handle_fallback(inputs, outputs) or self._handle_wrong_place(inputs):
            return
        if self._moves.arrived(inputs.time, inputs.state):
            self._enter(Phase.SEARCHING, inputs.time, "looking for the target")

    def _searching(self, inputs: Inputs, outputs: Outputs) -> None:
        if self._handle_fallback(inputs, outputs) or self._handle_wrong_place(inputs):
            return
        if self._moves.places_visited < self.legs:
            if self._moves.arrived(inputs.time, inputs.state):
                self._go_to_next_search_place(inputs, outputs, "mapping the lines")
            return
        target, why = self._usable_now(inputs)
        if target is not None:
            if self._target_since is None:
                self._target_since = inputs.time
                self.message = "target in view"
            if inputs.time - self._target_since >= self.settings.target_settle and self._moves.arrived(inputs.time, inputs.state):
                self.at_target(inputs, outputs, target)
            return
        self._target_since = None
        if self._elapsed(inputs) > self._goal.search_timeout:
            self._end(outputs, Result.NOT_FOUND, f"no target within {self._goal.search_timeout:g} s: {why}")
            return
        if self._moves.arrived(inputs.time, inputs.state) and self._moves.dwell_done(inputs.time):
            self._go_to_next_search_place(inputs, outputs, f"looking for the target ({why})")

    def _go_to_next_search_place(self, inputs: Inputs, outputs: Outputs, message: str) -> None:
        """Fly to the next place of the pattern."""
        place = self._moves.next_search_place(self.pattern(), lambda offset, p: self.reach(offset, p, inputs.target))
        self._go(inputs, outputs, place)
        self.message = message

    def _recovering(self, inputs: Inputs, outputs: Outputs) -> None:
        resting = inputs.controller is ControllerState.HOVERING and self._moves.slow(inputs.state)
        if self.holds(inputs):
            self._contact_time = inputs.time
            outputs.commands.append((Command.ATTACHED, "contact detected during the recovery"))
            self._enter(Phase.PERCHED, inputs.time, "attached, motors off")
            return
        if inputs.controller in (ControllerState.DISARMED, ControllerState.LANDING):
            landing = inputs.controller is ControllerState.LANDING
            result = Result.CANCELLED if self._cancelled else Result.TRACKING_LOST if landing else Result.CRASHED
            self._end(outputs, result, f"{self._failure}; {inputs.controller_message if landing else 'on the ground'}")
        elif self._elapsed(inputs) > self.settings.phase_timeout:
            outputs.commands.append((Command.LAND, "recovery took too long"))
            why = f"no hover within {self.settings.phase_timeout:g} s ({inputs.controller_message}), landing was commanded"
            self._end(outputs, Result.TRACKING_LOST, f"{self._failure}; {why}")
        elif resting and self._elapsed(inputs) > self.settings.settle_time:
            self._recovered(inputs, outputs)

    def _recovered(self, inputs: Inputs, outputs: Outputs) -> None:
        """End the goal or start another attempt, after a recovery has ended in a hover."""
        self._attempts_left -= 1
        if self._cancelled:
            self._end(outputs, Result.CANCELLED, "cancelled; hovering")
        elif self._attempts_left > 0:
            self._go_to_search(inputs, outputs, f"{self._failure}; {self._attempts_left} attempts left")
        else:
            self._end(outputs, Result.MISSED, f"{self._failure}; recovered to a hover")

    def _go_to_search(self, inputs: Inputs, outputs: Outputs, message: str, on_ground: bool = False) -> None:
        """Fly from the ground or from the present hover to the search place."""
        self._moves.begin(self._goal, inputs.state, on_ground)
        self._enter(Phase.TAKE_OFF, inputs.time, message)
        self._go(inputs, outputs, self._moves.search)

    def _go(self, inputs: Inputs, outputs: Outputs, place: Place) -> None:
        outputs.reference, outputs.trajectory_id = self._moves.go(inputs.time, place), self._new_id()

    def _usable_now(self, inputs: Inputs) -> tuple[Target | None, str]:
        """Return the target where it is recent and certain enough to plan on; otherwise None, and the reason."""
        if inputs.target is None or inputs.target.time < self._entered_search:
            return None, self.no_target_message
        why = unusable_reason(inputs.target, self._goal, self.settings)
        return None if why else inputs.target, why

    # -- endings -----------------------------------------------------------------------------------------------------

    def _handle_fallback(self, inputs: Inputs, outputs: Outputs) -> bool:
        """Whether the phase was left, as the controller recovers or descends, or as a move does not come to rest."""
        if inputs.controller is ControllerState.RECOVERING:
            self._fail_without_retry(inputs, f"controller recovers: {inputs.controller_message}")
            return True
        if self._handle_descent(inputs, outputs):
            return True
        limit = self._moves.length + self.settings.phase_timeout
        if (self.phase in (Phase.TAKE_OFF, Phase.SEARCHING) and inputs.time - self._moves.began > limit
                and not self._moves.arrived(inputs.time, inputs.state)):
            outputs.commands.append((Command.LAND, "search hover not reached"))
            self._end(outputs, Result.TIMEOUT, f"search hover not reached within {limit:.0f} s; landing")
            return True
        return False

    def _handle_descent(self, inputs: Inputs, outputs: Outputs) -> bool:
        """End the goal where the controller lands or has landed; returns whether it does. The landing is not reversed."""
        if inputs.controller not in (ControllerState.LANDING, ControllerState.DISARMED):
            return False
        self._end(outputs, Result.TRACKING_LOST, f"controller descends: {inputs.controller_message}")
        return True

    def _handle_wrong_place(self, inputs: Inputs) -> bool:
        """Recover where the controller hovers elsewhere than commanded, as it has left the move; returns whether it does."""
        if inputs.controller is not ControllerState.HOVERING or not self._moves.missed_destination(inputs.time, inputs.state):
            return False
        self._fail_without_retry(inputs, f"the controller left the way to the search place: {inputs.controller_message}")
        return True

    def _fail_without_retry(self, inputs: Inputs, why: str) -> None:
        """Recover without a further attempt, as the controller has left the way to the target or was commanded to."""
        self._attempts_left = 1
        self._fail_attempt(inputs, why)

    def _fail_attempt(self, inputs: Inputs, why: str) -> None:
        self._failure = why
        self._enter(Phase.RECOVERING, inputs.time, why)

    def _cancel(self, inputs: Inputs, outputs: Outputs) -> None:
        self._cancelled = True
        if self.phase is Phase.PERCHED:
            self.message = "cancelled too late: perched"  # the goal ends when the surface is known to hold the vehicle
        elif inputs.controller in (ControllerState.DISARMED, ControllerState.ARMED):
            # By now it may have taken off: one of the two is refused.
            outputs.commands += [(Command.LAND, "cancelled"), (Command.DISARM, "cancelled")]
            self._end(outputs, Result.CANCELLED, "cancelled on the ground")
        elif inputs.controller is ControllerState.ATTACHED and self.phase is Phase.ARMING:
            self._end(outputs, Result.CANCELLED, "cancelled; perched as before")
        else:
            self._too_late = self.committed(inputs.time)
            if self._too_late:
                self.cancelled_too_late(inputs, outputs)
            else:
                self._cancel_to_hover(inputs, outputs)

    def _cancel_to_hover(self, inputs: Inputs, outputs: Outputs) -> None:
        if inputs.controller is not ControllerState.LANDING:
            outputs.commands.append((Command.HOVER, "cancelled"))
        self._fail_attempt(inputs, "cancelled")

    def _end(self, outputs: Outputs, result: Result, message: str, contact_time: float = float("nan")) -> None:
        outputs.outcome = Outcome(result, message, contact_time)
        self.phase, self.message = Phase.IDLE, message

    def _enter(self, phase: Phase, time: float, message: str) -> None:
        self.phase, self.message, self.since = phase, message, time
        if phase is Phase.ARMING:
            self._requested_at, self._entered_search = None, time
        if phase is Phase.SEARCHING:
            self._target_since, self._moves.places_visited, self._entered_search = None, 0, time

    def _elapsed(self, inputs: Inputs) -> float:
        return inputs.time - self.since

    def _new_id(self) -> int:
        return next(self._ids)
