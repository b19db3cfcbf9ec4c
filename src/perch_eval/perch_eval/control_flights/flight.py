"""A flight led by a script: take-off, hover, perch; plant, VIO model, estimator and planner as everywhere.

Truth enters the controller through the sensors' models alone; the pad is localised without an error of its own, so that what is
measured is the controller.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from perch_control.controller import Controller
from perch_control.mission import Target
from perch_control.mission.parameters import MissionParameters
from perch_control.modes import Command, State
from perch_core import config, so3
from perch_core.errors import PerchError
from perch_core.trajectory import FlatTrajectory
from perch_core.values import PerchPlanRequest, nanoseconds
from perch_eval.control_flights.pilot import LEAD, ScriptedPilot
from perch_eval.in_process import arrange
from perch_eval.in_process.parameters import NodeParameters
from perch_sim.scenario import Scenario
from perch_sim.scenario_files import scenario_mapping

EVERY_STEP = {"controller.reference_period": 0.002}
"""Parameter of the controller: its reference is judged at every step."""


def scenario_of(name: str, changes: Mapping[str, Any], controller: Mapping[str, Any]) -> Scenario:
    """A scenario with changes, and parameters of the controller in the place of its own."""
    mapping = {**scenario_mapping(name), "parameters": {"controller": {**EVERY_STEP, **controller}}, **changes}
    return config.from_mapping(Scenario, mapping, name)


class ControlFlight:
    """Owns the loop and leads it; `step` is one control period.

    Attributes:
        loop: everything that flies.
        pilot: gives the orders.
        simulation: the vehicle.
        plan: trajectory of the perch that was ordered.
        events: (time [s], state of the controller, text) of its log.
    """

    def __init__(self, scenario: Scenario, seed: int) -> None:
        """
        Raises:
            ConfigError: the scenario or a node's parameter is refused.
        """
        self.scenario = scenario
        self.pilot = ScriptedPilot(NodeParameters(scenario, seed).of("mission", MissionParameters))
        self.loop = arrange(scenario, seed, without=("target_localizer",), pilot=self.pilot)
        self.simulation = self.loop.vehicle.simulation
        self.controller: Controller = self.loop.components["controller"]
        self.plan: FlatTrajectory | None = None
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
            PerchError: the estimator is not ready within 10 s.
        """
        while not self.pilot.ready:
            if self.time > 11.0:
                raise PerchError(f"the estimator is not ready: {self.pilot.estimator.message}")
            self.step()
        self.run(self.time + 0.2)
        ordered = self.time
        self.pilot.order(Command.ARM, "scripted flight")
        self.step()
        return ordered

    def flew(self, order: int | None) -> bool:
        """Whether the controller has taken up an order; where it has not, its last event says why."""
        return any(status.trajectory_id == order for status in self.loop.trace.values("controller/status"))

    def perch_plan(self, p: np.ndarray, start: float, shift: np.ndarray) -> FlatTrajectory:
        """The planner's perch from a hover; with L1, on the thrust that the controller has measured of it in hover.

        Args:
            p: hover [m], as estimated.
            start: time of its start [s].
            shift: estimated minus true position [m]: the pad is localised from where the vehicle believes to be.

        Raises:
            PerchError: there is none.
        """
        pad, planner = self.simulation.pad, self.loop.components["perching_planner"].config
        left, vehicle = self.controller.flight.thrust_known, self.simulation.vehicle
        thrust = None if left is None else left * (planner.thrust_max or planner.thrust_reserve * 4.0 * vehicle.thrust_max)
        [answer] = self.loop.request("perching_planner", "plan_perch", PerchPlanRequest(
            start=nanoseconds(start), p=p, p_WS=pad.p_WS + shift, q_WS=so3.quat_from_matrix(pad.R_WS), thrust_max=thrust))
        if not answer.success:
            raise PerchError(answer.message)
        return answer.trajectory

    def perch(self, place: np.ndarray) -> int | None:
        """Plan a perch from the place of the hover [m], and order it where the vehicle rests; None elsewhere."""
        if not self.pilot.resting:
            return None
        shift, pad = self.pilot.p_WB - self.simulation.state.p_WB, self.simulation.pad
        self.plan = self.perch_plan(place, self.time + 2.0 * LEAD, shift)
        return self.pilot.perch(self.plan, Target(self.time, pad.p_WS + shift, so3.quat_from_matrix(pad.R_WS), 0.0, 0.0))
