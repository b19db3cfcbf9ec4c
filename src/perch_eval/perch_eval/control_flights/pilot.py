"""A pilot in the place of the mission: it sends the orders that it is given, and stops the motors when the IMU shows that the surface carries the vehicle."""

from __future__ import annotations

import numpy as np

from perch_control.mission import Target
from perch_control.mission import State as BodyState
from perch_control.mission.adhesion import AdhesionMonitor
from perch_control.mission.parameters import MissionParameters
from perch_control.modes import Command, State
from perch_core.component import Component, Input, Output, Wake
from perch_core.trajectory import FlatTrajectory, rest_to_rest
from perch_core.values import (
    AtEnd, ControllerCommand, ControllerStatus, ControlReference, EstimatorHealth, ImuSample, OdometryState, TrajectoryOrder, seconds)

LEAD = 0.04           # from an order to its start [s]
TAKE_OFF_SPEED = 0.8  # mean [m/s]
RUNNING = 1           # of `EstimatorHealth.state`


class ScriptedPilot(Component[MissionParameters]):
    """Orders what a script calls for between two steps; works at every step, before the controller.

    Attributes:
        state: of the controller, as it last told.
        believed: newest odometry.
        estimator: newest health.
        wanted: where the controller last wanted to be [m], shape (3,).
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
    check_contact = Wake(0.02)

    def __init__(self, config: MissionParameters) -> None:
        super().__init__(config)
        self._adhesion, self._forces = AdhesionMonitor(config.mission.adhesion), []
        self._orders = 0
        self._target: Target | None = None
        self.state, self.message, self.flown = State.DISARMED, "", 0
        self.believed: OdometryState | None = None
        self.estimator: EstimatorHealth | None = None
        self.wanted = np.zeros(3)
        self.contact_due = np.inf

    # -- what is known -----------------------------------------------------------------------------------------------

    def on_imu(self, sample: ImuSample) -> None:
        """For the adhesion."""
        self._forces.append(sample.f_B)

    def on_odometry(self, state: OdometryState) -> None:
        """Where the vehicle believes to be."""
        self.believed = state

    def on_controller_status(self, status: ControllerStatus) -> None:
        """What it does."""
        self.state, self.message, self.flown = State(status.state), status.message, status.trajectory_id

    def on_reference(self, reference: ControlReference) -> None:
        """Where it wants to be."""
        self.wanted = np.array(reference.p)

    def on_estimator_status(self, health: EstimatorHealth) -> None:
        """Whether it is ready."""
        self.estimator = health

    @property
    def ready(self) -> bool:
        """Whether the estimator is."""
        return self.estimator is not None and self.estimator.state == RUNNING

    @property
    def time(self) -> float:
        """Of the newest odometry [s]."""
        return seconds(self.believed.stamp)

    @property
    def p_WB(self) -> np.ndarray:
        """Where the vehicle believes to be [m], shape (3,)."""
        return np.array(self.believed.p_WB)

    @property
    def resting(self) -> bool:
        """Whether it hovers without moving."""
        return self.state is State.HOVERING and float(np.linalg.norm(self.believed.v_B)) < self.config.mission.settle_speed

    # -- orders ------------------------------------------------------------------------------------------------------

    def order(self, command: Command, reason: str) -> None:
        """Command the controller."""
        self.command(ControllerCommand(self.believed.stamp if self.believed else 0, int(command), reason))

    def follow(self, trajectory: FlatTrajectory, at_end: AtEnd = AtEnd.HOLD) -> int:
        """Order a trajectory; its number."""
        self._orders += 1
        self.trajectory(TrajectoryOrder.of(self._orders, trajectory, at_end, self.config.mission.contact_time))
        return self._orders

    def go(self, offset: np.ndarray, duration: float) -> int:
        """Order a move by an offset [m] from where the vehicle is or is on its way to, at rest at both ends."""
        p = self.wanted if self.state is State.HOVERING else self.p_WB
        return self.follow(rest_to_rest(p, p + offset, 0.0, 0.0, duration, self.time + LEAD))

    def perch(self, trajectory: FlatTrajectory, target: Target) -> int:
        """Order a perch on a target."""
        self._target, self.contact_due = target, trajectory.start_time + trajectory.duration
        return self.follow(trajectory, AtEnd.CONTACT)

    # -- the contact -------------------------------------------------------------------------------------------------

    def on_check_contact(self, now: int) -> None:
        """What the mission does after a perch."""
        self._adhesion.add(np.array(self._forces).reshape(-1, 3))
        self._forces.clear()
        m = self.config.mission
        if self._target is None or not (-m.contact_early < self.time - self.contact_due < m.contact_time + 0.2) or self.state is not State.TRACKING:
            self._adhesion.reset()
            return
        e = self.believed
        if self._adhesion.attached(BodyState(*(np.array(x) for x in (e.p_WB, e.q_WB, e.v_WB, e.w_B))), self._target):
            self._target = None
            self.order(Command.ATTACHED, "the surface carries the vehicle")
