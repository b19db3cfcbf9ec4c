"""Flights led by a script in the place of the mission: take-off, moves, perch; plant, VIO model, estimator and planner as everywhere.

Truth enters the controller through the sensors' models alone; the pad is localised without an error of its own, so that what is
measured is the controller.
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
from perch_control.modes import Command, State
from perch_core import config, so3
from perch_core.component import Component, Input, Output, Timer
from perch_core.errors import PerchError
from perch_core.extends import extended_mapping
from perch_core.trajectory import FlatTrajectory, rest_to_rest
from perch_core.values import (
    AtEnd, ControllerCommand, ControllerStatus, ControlReference, EstimatorHealth, ImuSample, OdometryState, PerchPlanRequest, TrajectoryOrder,
    nanoseconds, seconds)
from perch_eval.in_process import arrange
from perch_eval.in_process.parameters import NodeParameters
from perch_sim.scenario import Scenario

LEAD = 0.04           # from an order to its start [s]
TAKE_OFF_SPEED = 0.8  # mean [m/s]
READY_TIMEOUT = 11.0  # until the estimator is ready, in simulated time [s]
EVERY_STEP = {"controller.reference_period": 0.002}
"""Parameter of the controller: its reference is judged at every step."""


def scenario_of(name: str, changes: Mapping[str, Any], controller: Mapping[str, Any]) -> Scenario:
    """A scenario with changes, and parameters of the controller in the place of its own."""
    mapping = {**extended_mapping("scenarios", name), "parameters": {"controller": {**EVERY_STEP, **controller}}, **changes}
    return config.from_mapping(Scenario, mapping, name)


class ScriptedMission(Component[MissionParameters]):
    """Sends the orders that a script calls for between two steps, and stops the motors when the IMU shows that the surface carries the
    vehicle. Works at every step, before the controller.

    Attributes:
        status: newest status of the controller.
        latest_odometry: newest odometry.
        estimator: newest health.
        reference_position: newest reference of the controller [m], shape (3,).
        contact_due: when the perch that was ordered meets the surface [s]; inf: none was.
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
        """For the adhesion."""
        self._forces.append(sample.f_B)

    def on_odometry(self, state: OdometryState) -> None:
        """Keep the newest odometry."""
        self.latest_odometry = state

    def on_controller_status(self, status: ControllerStatus) -> None:
        """Keep the newest status of the controller."""
        self.status = status

    def on_reference(self, reference: ControlReference) -> None:
        """Keep the newest reference of the controller."""
        self.reference_position = np.array(reference.p)

    def on_estimator_status(self, health: EstimatorHealth) -> None:
        """Keep the newest health of the estimator."""
        self.estimator = health

    @property
    def state(self) -> State:
        """Newest state of the controller."""
        return State.DISARMED if self.status is None else State(self.status.state)

    @property
    def message(self) -> str:
        """Of the controller."""
        return "" if self.status is None else self.status.message

    @property
    def time(self) -> float:
        """Of the newest odometry [s]."""
        return seconds(self.latest_odometry.stamp)

    @property
    def p_WB(self) -> np.ndarray:
        """Estimated position [m], shape (3,)."""
        return np.array(self.latest_odometry.p_WB)

    @property
    def resting(self) -> bool:
        """Whether it hovers without moving."""
        return self.state is State.HOVERING and float(np.linalg.norm(self.latest_odometry.v_B)) < self.config.mission.settle_speed

    def order(self, command: Command, reason: str) -> None:
        """Command the controller."""
        self.command(ControllerCommand(self.latest_odometry.stamp, int(command), reason))

    def follow(self, trajectory: FlatTrajectory, at_end: AtEnd = AtEnd.HOLD) -> int:
        """Order a trajectory; its number."""
        self._orders += 1
        self.trajectory(TrajectoryOrder.of(self._orders, trajectory, at_end, self.config.mission.contact_time))
        return self._orders

    def move(self, offset: np.ndarray, duration: float) -> int:
        """Order a move by an offset [m] from where the vehicle is or is on its way to, at rest at both ends."""
        p = self.reference_position if self.state is State.HOVERING else self.p_WB
        return self.follow(rest_to_rest(p, p + offset, 0.0, 0.0, duration, self.time + LEAD))

    def perch(self, trajectory: FlatTrajectory, target: Target) -> int:
        """Order a perch on a target."""
        self._target, self.contact_due = target, trajectory.start_time + trajectory.duration
        return self.follow(trajectory, AtEnd.CONTACT)

    def on_check_contact(self, now: int) -> None:
        """What the mission does after a perch."""
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
    """A flight that its owner leads.

    Attributes:
        loop: everything that flies.
        mission: gives the orders.
        simulation: the vehicle.
        events: (time [s], state of the controller, text) of its log.
    """

    def __init__(self, scenario: Scenario, seed: int, without: Collection[str] = ()) -> None:
        """
        Args:
            scenario: what is flown.
            seed: of everything that is random.
            without: components beside the target localiser that do not take part.

        Raises:
            ConfigError: the scenario or a node's parameter is refused.
        """
        self.scenario = scenario
        self.mission = ScriptedMission(NodeParameters(scenario, seed).of("mission", MissionParameters))
        self.loop = arrange(scenario, seed, without=("target_localizer", *without), script=self.mission)
        self.simulation = self.loop.vehicle.simulation
        self.controller: Controller = self.loop.components["controller"]
        self.events: list[tuple[float, str, str]] = []
        self.controller.log.receivers.append(lambda line: self.events.append((self.time, self.state.name, line.text)))

    @property
    def time(self) -> float:
        """[s]"""
        return self.loop.time

    @property
    def state(self) -> State:
        """Of the controller at this step."""
        return self.controller.flight.state

    def step(self) -> None:
        """One control period."""
        self.loop.step()

    def run(self, until: float) -> None:
        """Fly on to a time [s], or to the end of the motors."""
        while self.time < until and not self.simulation.plant.crashed:
            self.step()

    def arm(self) -> float:
        """Wait for the estimator, and arm; returns when that was ordered [s].

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
        """Whether the controller has accepted an order; if it has not, its last event has the reason."""
        return any(status.trajectory_id == order for status in self.loop.trace.values("controller/status"))

    def perch_plan(self, p: np.ndarray, start: float, shift: np.ndarray) -> FlatTrajectory:
        """The planner's perch from a hover.

        Args:
            p: hover [m], as estimated.
            start: time of its start [s].
            shift: estimated minus true position [m]: the pad is localised relative to the estimated position.

        Raises:
            PerchError: there is none.
        """
        pad = self.simulation.pad
        [answer] = self.loop.request("perching_planner", "plan_perch", PerchPlanRequest(
            start=nanoseconds(start), p=p, p_WS=pad.p_WS + shift, q_WS=so3.quat_from_matrix(pad.R_WS),
            thrust_ratio=self.controller.flight.thrust_ratio))
        if not answer.success:
            raise PerchError(answer.message)
        return answer.trajectory

    def perch(self, place: np.ndarray) -> int | None:
        """Plan a perch from the place of the hover [m], and order it where the vehicle rests; None elsewhere."""
        if not self.mission.resting:
            return None
        shift, pad = self.mission.p_WB - self.simulation.state.p_WB, self.simulation.pad
        plan = self.perch_plan(place, self.time + 2.0 * LEAD, shift)
        return self.mission.perch(plan, Target(self.time, pad.p_WS + shift, so3.quat_from_matrix(pad.R_WS), 0.0, 0.0))
