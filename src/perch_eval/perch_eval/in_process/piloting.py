"""Mirrors `perch_control.controller_node`: orders and odometry in, motor commands and status out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from perch_control.admission import AtEnd, Order
from perch_control.assembly import Assembly
from perch_control.modes import Command, StepResult
from perch_control.nmpc import chosen_lines
from perch_control.parameters import ControllerParameters
from perch_core.errors import PerchError
from perch_core.lines import Segment
from perch_core.trajectory import FlatTrajectory, SampledTrajectory
from perch_core.vehicle import Vehicle
from perch_eval.in_process.estimation import Odometry
from perch_perception.ukf import ImuSample, Status

STATUS_STEPS = 10


@dataclass(frozen=True, slots=True)
class FlownTrajectory:
    """A trajectory as published: `perch_msgs/Trajectory` without ROS."""

    id: int
    trajectory: FlatTrajectory | SampledTrajectory
    at_end: AtEnd
    contact_time: float = 0.0
    recovery_start: float = -1.0
    ready: bool = False  # not to be flown but to be kept ready: topic `recovery`


@dataclass(frozen=True, slots=True)
class PilotStatus:
    """What `controller/status` tells the mission."""

    state: int
    message: str
    trajectory_id: int
    trajectory_time: float


class Piloting:
    """Owns the flight controller."""

    def __init__(self, params: ControllerParameters, vehicle: Vehicle) -> None:
        self._assembly = Assembly(params, vehicle)
        self._flight, self._nmpc = self._assembly.flight, self._assembly.nmpc
        self._watched = params.nmpc.lines.watched

    def command(self, command: Command, reason: str) -> None:
        """A command that counts from this step on."""
        try:
            self._flight.command(command, reason)
        except ValueError as error:
            self._flight.maneuvers.message = str(error)

    def follow(self, order: FlownTrajectory) -> None:
        """A trajectory that counts from this step on."""
        source = self._assembly.reference(order.trajectory)
        try:
            take = self._flight.keep_ready if order.ready else self._flight.follow
            take(Order(order.id, source, order.trajectory.start_time, order.at_end, order.contact_time, order.recovery_start))
        except PerchError as error:
            if not order.ready:
                self._flight.maneuvers.message = f"trajectory {order.id} refused: {error}"

    def step(self, time: float, imu: ImuSample, odometry: Odometry) -> StepResult:
        """The motor command of a step."""
        self._flight.imu(time, imu.w_B, imu.f_B)
        return self._flight.step(time, odometry.sample)

    def see(self, lines: Sequence[Segment]) -> None:
        """The map of powerlines, for the line terms of the NMPC."""
        if self._nmpc is not None and self._nmpc.settings.lines.any:
            self._nmpc.lines(chosen_lines(lines, np.array(self._flight.maneuvers.belief[0:3]), self._watched))

    def hear(self, estimator: Status) -> None:
        """The estimator's health, at every 50th step."""
        self._flight.supervisor.estimator(estimator.health.value, float(estimator.vio_age), estimator.message)

    @property
    def status(self) -> PilotStatus:
        """As published at every 10th step."""
        flight, maneuvers = self._flight, self._flight.maneuvers
        return PilotStatus(int(flight.state), maneuvers.message, maneuvers.trajectory_id, float(flight.trajectory_time))
