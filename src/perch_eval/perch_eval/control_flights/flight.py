"""One flight of the controller's core: plant, IMU, VIO model, UKF, supervisor and law; take-off, hover, perch; no ROS.

Orders come from a script in place of the mission. Truth enters the controller through the sensors' models alone; the pad is
localised without an error of its own, so that what is measured is the controller.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from perch_control.admission import AtEnd, Order
from perch_control.assembly import Assembly
from perch_control.mission import State as BodyState
from perch_control.mission import Target
from perch_control.mission.adhesion import AdhesionMonitor
from perch_control.mission.parameters import MissionParameters
from perch_control.modes import Command, State, StepResult
from perch_control.parameters import ControllerParameters
from perch_control.reference import FlatReference
from perch_core import so3
from perch_core.errors import PerchError
from perch_core.scenario import Scenario
from perch_core.surface import PerchSurface
from perch_core.timing import TICK_STEPS
from perch_core.trajectory import FlatTrajectory, rest_to_rest
from perch_eval.in_process.estimation import STATUS_STEPS as HEALTH_STEPS
from perch_eval.in_process.estimation import Odometry
from perch_eval.in_process.parameters import NodeParameters
from perch_eval.in_process.sensed_vehicle import SensedVehicle
from perch_perception.ukf import Health, ImuSample
from perch_planner.perching_planner_node import PerchingPlannerParameters
from perch_planner.planner import plan
from perch_planner.problem import PerchProblem, StartState
from perch_sim.contact_event import ContactEvent

LEAD = 0.04     # from an order to its start [s]
TAKE_OFF_SPEED = 0.8  # mean [m/s]


class ControlFlight:
    """Owns everything that flies; `step` is one control period.

    Attributes:
        controller: the flight controller with its supervisor.
        sensing, simulation: the vehicle, and what is known of it.
        target, plan, contact_due: pad, trajectory and time of contact [s] of the perch that was ordered.
        references: time [s], reference (3) and true position (3) [m] of each step in flight.
        events: (time [s], state, text) of the controller.
        contacts: what the vehicle truly touched.
        orders_lost: no trajectory reaches the controller any more.
    """

    def __init__(self, scenario: Scenario, seed: int) -> None:
        """
        Raises:
            ConfigError: the scenario or a node's parameter is refused.
        """
        params = NodeParameters(scenario, seed)
        self.scenario, self.sensing = scenario, SensedVehicle(scenario, params, seed)
        self.simulation = self.sensing.simulation
        vehicle = self.vehicle = self.simulation.vehicle
        self.params = params.of("controller", ControllerParameters)
        self.controller = Assembly(self.params, vehicle).flight
        self.mission = params.of("mission", MissionParameters).mission
        self._planner = params.of("perching_planner", PerchingPlannerParameters)
        self._adhesion, self._felt = AdhesionMonitor(self.mission.adhesion), []
        self._orders = 0
        self.target: Target | None = None
        self.plan: FlatTrajectory | None = None
        self.contact_due = np.inf
        self.events: list[tuple[float, str, str]] = []
        self.contacts: list[ContactEvent] = []
        self.references: list[tuple[float, ...]] = []
        self.orders_lost = False

    @property
    def time(self) -> float:
        """[s]"""
        return self.sensing.time

    @property
    def odometry(self) -> Odometry:
        """What the estimator says at this step."""
        return self.sensing.odometry

    # -- one step ----------------------------------------------------------------------------------------------------

    def step(self) -> None:
        """One control period."""
        output = self.sensing.step()
        time, imu = self.time, self.sensing.imu
        self.controller.imu(time, imu.w_B, imu.f_B)
        result = self.answer(time)
        if result is not None:
            self._carry_out(time, result, output.state.p_WB)
        if (self.sensing.index - 1) % HEALTH_STEPS == 0:
            status = self.sensing.estimation.status
            self.controller.supervisor.estimator(status.health.value, float(status.vio_age), status.message)
        self.contacts.extend(output.contacts)
        self._feel(imu)

    def answer(self, time: float) -> StepResult | None:
        """The controller's answer to the odometry of this step; None: it was not asked."""
        return self.controller.step(time, self.odometry.sample)

    def _carry_out(self, time: float, result: StepResult, p_WB: np.ndarray) -> None:
        self.simulation.motors.command(self.simulation.time, result.armed, np.array(result.rotor_speed))
        if result.event:
            self.events.append((time, self.controller.state.name, result.event))
        if result.setpoint is not None:
            self.references.append((time, *result.setpoint.p, *p_WB.tolist()))

    def _feel(self, imu: ImuSample) -> None:
        """What the mission does after a perch: the motors stop where the surface is felt to carry the vehicle."""
        self._felt.append(imu.f_B)
        if (self.sensing.index - 1) % TICK_STEPS:
            return
        self._adhesion.add(np.array(self._felt))
        self._felt.clear()
        m, e = self.mission, self.odometry.estimate
        since = self.time - self.contact_due
        if -m.contact_early < since < m.contact_time + 0.2 and self.controller.state is State.TRACKING:
            if self._adhesion.attached(BodyState(e.p_WB, e.q_WB, self.odometry.v_WB, e.w_WB_B), self.target):
                self.controller.command(Command.ATTACHED, "the surface carries the vehicle")
        else:
            self._adhesion.reset()

    def run(self, until: float) -> None:
        """Fly on to a time [s], or to the end of the motors."""
        while self.time < until and not self.simulation.plant.crashed:
            self.step()

    # -- orders ------------------------------------------------------------------------------------------------------

    def arm(self) -> None:
        """Wait for the estimator, and arm.

        Raises:
            PerchError: the estimator is not ready within 10 s.
        """
        while self.sensing.estimation.status.health is not Health.RUNNING:
            if self.time > 11.0:
                raise PerchError(f"the estimator is not ready: {self.sensing.estimation.status.message}")
            self.step()
        self.run(self.time + 0.2)
        self.controller.command(Command.ARM, "scripted flight")

    def follow(self, trajectory: FlatTrajectory, at_end: AtEnd = AtEnd.HOLD) -> bool:
        """Give the controller a trajectory; False where it refuses, or no order reaches it."""
        if self.orders_lost:
            return False
        self._orders += 1
        try:
            self.controller.follow(Order(self._orders, FlatReference(trajectory), trajectory.start_time, at_end, self.mission.contact_time))
        except PerchError as error:
            self.events.append((self.time, self.controller.state.name, f"refused: {error}"))
            return False
        return True

    def go(self, offset: np.ndarray, duration: float) -> bool:
        """Order a move by an offset [m] from where the vehicle is or is on its way to, at rest at both ends."""
        held = self.controller.state is State.HOVERING
        p = np.array(self.controller.maneuvers.setpoint().p) if held else self.odometry.estimate.p_WB
        return self.follow(rest_to_rest(p, p + offset, 0.0, 0.0, duration, self.time + LEAD))

    def perch_plan(self, p: np.ndarray, start: float, shift: np.ndarray) -> FlatTrajectory:
        """The planner's perch from a hover.

        Args:
            p: hover [m], as estimated.
            start: time of its start [s].
            shift: estimated minus true position [m]: the pad is localised from where the vehicle believes to be.

        Raises:
            PlanningRefusal: there is none.
        """
        pad = self.simulation.pad
        surface = PerchSurface(pad.p_WS + shift, pad.R_WS, pad.size)
        found = plan(PerchProblem(StartState(p), surface), self._planned_with(), self.vehicle).trajectory
        return FlatTrajectory(found.durations, found.coefficients, start)

    def _planned_with(self) -> PerchingPlannerParameters:
        """The planner's parameters; with L1, `thrust_max` is what the controller has measured of it in hover."""
        settings, left = self._planner, self.controller.thrust_known
        if left is None:
            return settings
        return replace(settings, thrust_max=left * (settings.thrust_max or settings.thrust_reserve * 4.0 * self.vehicle.thrust_max))

    def perch(self, place: np.ndarray) -> bool:
        """Plan a perch from the place of the hover [m], and order it where the vehicle rests; the controller refuses it elsewhere."""
        resting = np.linalg.norm(self.odometry.v_WB) < self.mission.settle_speed
        if self.controller.state is not State.HOVERING or self.orders_lost or not resting:
            return False
        shift = self.odometry.estimate.p_WB - self.simulation.state.p_WB
        start = self.time + 2.0 * LEAD
        trajectory = self.perch_plan(place, start, shift)
        if not self.follow(trajectory, AtEnd.CONTACT):
            return False
        pad = self.simulation.pad
        self.target = Target(self.time, pad.p_WS + shift, so3.quat_from_matrix(pad.R_WS), 0.0, 0.0)
        self.contact_due, self.plan = start + trajectory.duration, trajectory
        return True
