"""Flights commanded by a script instead of the mission: take-off, moves, perch. All other components are as usual.

The truth reaches the controller only through the sensor models. The pad is localised without an error of its own, so that the
controller is what is measured.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

import numpy as np

from perch_control.controller import Controller
from perch_control.mission import State as BodyState
from perch_control.mission import Target
from perch_control.mission.adhesion import AdhesionMonitor
from perch_control.mission.parameters import MissionParameters
from perch_control.mission_component import RUNNING
from perch_control.modes import State
from perch_core import config, so3
from perch_core.component import Component, Input, Output, Timer
from perch_core.errors import PerchError
from perch_core.extends import extended_mapping
from perch_core.trajectory import FlatTrajectory, rest_to_rest
from perch_core.values import (
    AtEnd, Command, ControlReference, ControllerCommand, ControllerStatus, EstimatorHealth, ImuSample, OdometryState,
    PerchPlanRequest, TrajectoryOrder, nanoseconds, seconds)
from perch_eval.in_process import arrange
from perch_eval.in_process.parameters import NodeParameters
from perch_sim.scenario import Scenario

LEAD = 0.04           # from an order to its start [s]
TAKE_OFF_SPEED = 0.8  # mean [m/s]
READY_TIMEOUT = 11.0  # until the estimator is ready, in simulated time [s]
EVERY_STEP = {"controller.reference_period": 0.002}
"""Parameter of the controller: the reference is published, and so evaluated, at every step."""


def scenario_of(name: str, changes: Mapping[str, Any], controller: Mapping[str, Any]) -> Scenario:
    """Return a scenario with changes; the given parameters of the controller replace the scenario's `parameters`."""
    mapping = {**extended_mapping("scenarios", name), "parameters": {"controller": {**EVERY_STEP, **controller}}, **changes}
    return config.from_mapping(Scenario, mapping, name)


class ScriptedMission(Component[MissionParameters]):
    """Sends the orders of a script between steps, and stops the motors when the IMU shows that the surface carries the vehicle.
    It runs at every step, before the controller.

    Attributes:
        status: newest status of the controller.
        latest_odometry: newest odometry.
        estimator: newest health of the estimator.
        reference_position: newest reference position of the controller [m], shape (3,).
        contact_due: planned time of contact of the ordered perch [s]; inf: none was ordered.
    """

    config_type = MissionParameters

    imu = Input(ImuSample, "imu/data_raw", lazy=True)
    odometry = Input(OdometryState, "odometry", lazy=True)
    controller_status = Input(ControllerStatus, "controller/status")
    reference = Input(ControlReference, "controller/reference")
    estimator_status = Input(EstimatorHealth, "estimator/status")
    trajectory = Output(TrajectoryOrder, "trajectory")
    command = Output(ControllerCommand, "controller/command")
    check_contact = Timer(0.02)

    latest_odometry: OdometryState

    def __init__(self, config: MissionParameters) -> None:
        super().__init__(config)
        self._adhesion = AdhesionMonitor()
        self._forces: list[tuple[float, float, float]] = []
        self._orders = 0
        self._target: Target | None = None
        self.status: ControllerStatus | None = None
        self.estimator: EstimatorHealth | None = None
        self.reference_position = np.zeros(3)
        self.contact_due = np.inf

    def on_imu(self, sample: ImuSample) -> None:
        """Store the specific force for the adhesion monitor."""
        self._forces.append(sample.f_B)

    def on_odometry(self, state: OdometryState) -> None:
        """Store the odometry."""
        self.latest_odometry = state

    def on_controller_status(self, status: ControllerStatus) -> None:
        """Store the controller's status."""
        self.status = status

    def on_reference(self, reference: ControlReference) -> None:
        """Store the reference position."""
        self.reference_position = np.array(reference.p)

    def on_estimator_status(self, health: EstimatorHealth) -> None:
        """Store the estimator's health."""
        self.estimator = health

    @property
    def state(self) -> State:
        """Newest state of the controller."""
        return State.DISARMED if self.status is None else State(self.status.state)

    @property
    def message(self) -> str:
        """Newest message of the controller."""
        return "" if self.status is None else self.status.message

    @property
    def time(self) -> float:
        """Time of the newest odometry [s]."""
        return seconds(self.latest_odometry.stamp)

    @property
    def p_WB(self) -> np.ndarray:
        """Estimated position of the vehicle [m], shape (3,)."""
        return np.array(self.latest_odometry.p_WB)

    @property
    def resting(self) -> bool:
        """Whether the vehicle hovers at rest."""
        return self.state is State.HOVERING and float(np.linalg.norm(self.latest_odometry.v_B)) < self.config.mission.settle_speed

    def order(self, command: Command, reason: str) -> None:
        """Send a command to the controller."""
        self.command(ControllerCommand(self.latest_odometry.stamp, int(command), reason))

    def follow(self, trajectory: FlatTrajectory, at_end: AtEnd = AtEnd.HOLD) -> int:
        """Order a trajectory and return its id."""
        self._orders += 1
        self.trajectory(TrajectoryOrder.of(self._orders, trajectory, at_end, self.config.mission.contact_time))
        return self._orders

    def move(self, offset: np.ndarray, duration: float) -> int:
        """Order a rest-to-rest move by an offset [m] from the reference (in a hover) or the estimate; return its id."""
        p = self.reference_position if self.state is State.HOVERING else self.p_WB
        return self.follow(rest_to_rest(p, p + offset, 0.0, 0.0, duration, self.time + LEAD))

    def perch(self, trajectory: FlatTrajectory, target: Target) -> int:
        """Order a perch on a target and return its id."""
        self._target, self.contact_due = target, trajectory.start_time + trajectory.duration
        return self.follow(trajectory, AtEnd.CONTACT)

    def on_check_contact(self, now: int) -> None:
        """Monitor the adhesion around the planned contact, as the mission does."""
        self._adhesion.add(np.array(self._forces).reshape(-1, 3))
        self._forces.clear()
        m = self.config.mission
        if self._target is None or not (-m.contact_early < self.time - self.contact_due < m.contact_time + 0.2) or self.state is not State.TRACKING:
            self._adhesion.reset()
            return
        e = self.latest_odometry
        if self._adhesion.attached(BodyState(*(np.array(x) for x in (e.p_WB, e.q_WB, e.v_WB, e.w_B))), self._target):
            self._target = None
            self.order(Command.ATTACHED, "the surface carries the vehicle")


class ScriptedFlight:
    """A flight that its owner steps and commands.

    Attributes:
        loop: simulated vehicle and components.
        mission: sends the orders.
        simulation: the vehicle.
        events: (time [s], state of the controller, text) of each line of the controller's log.
    """

    def __init__(self, scenario: Scenario, seed: int, without: Collection[str] = ()) -> None:
        """
        Args:
            scenario: to fly.
            seed: of every random number.
            without: components that are left out, in addition to the target localiser.

        Raises:
            ConfigError: the scenario or a node's parameter is refused.
        """
        self.scenario = scenario
        self.mission = ScriptedMission(NodeParameters(scenario, seed).node_config("mission", MissionParameters))
        self.loop = arrange(scenario, seed, without=("target_localizer", *without), script=self.mission)
        self.simulation = self.loop.vehicle.simulation
        self.controller: Controller = self.loop.components["controller"]
        self.events: list[tuple[float, str, str]] = []
        self.controller.log.receivers.append(lambda line: self.events.append((self.time, self.state.name, line.text)))

    @property
    def time(self) -> float:
        """Time of the flight [s]."""
        return self.loop.time

    @property
    def state(self) -> State:
        """State of the controller at this step."""
        return self.controller.flight.state

    def step(self) -> None:
        """Advance by one control period."""
        self.loop.step()

    def run(self, until: float) -> None:
        """Advance to a time [s], or until the rotors are broken."""
        while self.time < until and not self.simulation.plant.crashed:
            self.step()

    def arm(self) -> float:
        """Wait for the estimator, then arm; return the time of that order [s].

        Raises:
            PerchError: the estimator is not ready in time.
        """
        while self.mission.estimator is None or self.mission.estimator.state != RUNNING:
            if self.time > READY_TIMEOUT:
                raise PerchError("the estimator is not ready" + (f": {self.mission.estimator.message}" if self.mission.estimator else ""))
            self.step()
        self.run(self.time + 0.2)
        ordered = self.time
        self.mission.order(Command.ARM, "scripted flight")
        self.step()
        return ordered

    def accepted(self, order: int | None) -> bool:
        """Return whether the controller has accepted an order; if not, its last event has the reason."""
        return any(status.trajectory_id == order for status in self.loop.trace.values("controller/status"))

    def perch_plan(self, p: np.ndarray, start: float, shift: np.ndarray) -> FlatTrajectory:
        """Plan a perch from a hover.

        Args:
            p: hover [m], as estimated.
            start: start time of the plan [s].
            shift: estimated minus true position [m]; the pad, localised from the estimate, is shifted by it.

        Raises:
            PerchError: the planner refuses.
        """
        pad = self.simulation.pad
        [answer] = self.loop.request("perching_planner", "plan_perch", PerchPlanRequest(
            start=nanoseconds(start), p=p, p_WS=pad.p_WS + shift, q_WS=so3.quat_from_matrix(pad.R_WS),
            thrust_ratio=self.controller.flight.thrust_ratio))
        if not answer.success:
            raise PerchError(answer.message)
        return answer.trajectory

    def perch(self, place: np.ndarray) -> int | None:
        """If the vehicle rests, plan a perch from the hover position [m] and order it; return its id, or None."""
        if not self.mission.resting:
            return None
        shift, pad = self.mission.p_WB - self.simulation.state.p_WB, self.simulation.pad
        plan = self.perch_plan(place, self.time + 2.0 * LEAD, shift)
        return self.mission.perch(plan, Target(self.time, pad.p_WS + shift, so3.quat_from_matrix(pad.R_WS), 0.0, 0.0))
