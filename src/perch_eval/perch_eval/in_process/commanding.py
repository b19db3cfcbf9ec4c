"""Mirrors `perch_control.mission_node`: what is known at a tick to what shall be done."""

from __future__ import annotations

import math

import numpy as np
from perch_msgs.msg import PowerlineArray

from perch_control.admission import AtEnd
from perch_control.mission import (
    Command, ControllerState, Goal, Inputs, MissionMachine, MissionSettings, Mode, Outcome, PlanAnswer, State, Target)
from perch_control.ros.planner_clients import perch_message
from perch_control.ros.powerline_map import mapped_target
from perch_core.ros.trajectories import from_message
from perch_core.scenario import Scenario
from perch_core.trajectory import FlatTrajectory
from perch_eval.in_process.estimation import Odometry
from perch_eval.in_process.piloting import FlownTrajectory, PilotStatus
from perch_eval.in_process.planning import Planning, PowerlinePlanning
from perch_eval.in_process.stamps import published, seconds
from perch_perception.ukf import Health, ImuSample, Status


def goal_of(scenario: Scenario) -> Goal:
    """The goal that a scenario's mission part describes; as `perch_eval.pilot.goal_of` sends it."""
    mission = scenario.mission
    points = {"powerline": mission.perch_point, "inspection": scenario.inspection.watched}
    return Goal(mission.takeoff_height, mission.search_timeout, mode=Mode[scenario.mode.upper()],
                perch_point=np.array(points.get(scenario.mode, (0.0, 0.0, 0.0))),
                perch_pitch=math.radians(mission.perch_pitch_deg), perception_aware=mission.perception_aware,
                replan=mission.replan, attempts=max(1, mission.attempts))


class Commanding:
    """Owns the mission's machine and its view of the world."""

    def __init__(self, settings: MissionSettings, planning: Planning | PowerlinePlanning | None, goal: Goal) -> None:
        self._settings, self._planning, self._goal = settings, planning, goal
        self._machine = MissionMachine(settings)
        self._target: Target | None = None
        self._map: PowerlineArray | None = None
        self._estimator: Status | None = None
        self._imu: list[tuple[float, float, float]] = []
        self._pending: tuple[float, PlanAnswer] | None = None
        self._started = False
        self.outcome: Outcome | None = None
        self.phases: list[tuple[float, str, str]] = []  # (time [s], phase, message) whenever they change

    def take(self, sighting: Target | PowerlineArray) -> None:
        """A target, or a map of powerlines, that counts from this step on."""
        if isinstance(sighting, Target):
            self._target = sighting
        else:
            self._map = sighting

    def hear(self, estimator: Status) -> None:
        """The estimator's health, at every 50th step."""
        self._estimator = estimator

    def feel(self, imu: ImuSample) -> None:
        """The IMU sample of each step."""
        self._imu.append(imu.f_B)

    def tick(self, stamp: int, odometry: Odometry, status: PilotStatus, cancel: bool) -> list[tuple[Command, str] | FlownTrajectory]:
        """What the mission publishes at a tick: commands, then trajectories."""
        time = seconds(stamp)
        if not self._started:
            self._started = True
            self._machine.start(self._goal, time)
        answer = None
        if self._pending is not None and time >= self._pending[0] - 1e-9:
            answer, self._pending = self._pending[1], None
        e, estimator = odometry.estimate, self._estimator
        target = self._target
        if self._goal.mode is not Mode.SURFACE:
            target = mapped_target(self._map, self._goal, e.p_WB) if self._map is not None else None
        outputs = self._machine.tick(Inputs(
            time=time, state=State(e.p_WB, e.q_WB, odometry.v_WB, e.w_WB_B),
            estimator_ready=estimator is not None and estimator.health is Health.RUNNING,
            controller=ControllerState(status.state), controller_message=status.message,
            trajectory_id=status.trajectory_id, trajectory_time=status.trajectory_time, target=target,
            specific_force_B=np.array(self._imu).reshape(-1, 3), plan=answer, cancel=cancel))
        self._imu.clear()
        published_items: list[tuple[Command, str] | FlownTrajectory] = list(outputs.commands)
        if outputs.reference is not None:
            flat = outputs.reference
            flat = FlatTrajectory(flat.durations, flat.coefficients, published(flat.start_time))
            published_items.append(FlownTrajectory(outputs.trajectory_id, flat, AtEnd.HOLD))
        if outputs.perch is not None:
            published_items.append(self._flown(outputs.trajectory_id, outputs.perch))
        if outputs.way_out is not None:
            msg = outputs.way_out.trajectory
            published_items.append(FlownTrajectory(outputs.trajectory_id, from_message(msg), AtEnd.HOLD, 0.0, 0.0, ready=True))
        if outputs.query is not None:
            self._pending = (time + outputs.query.latency, self._planning.answer(outputs.query))
        if outputs.outcome is not None:
            self.outcome = outputs.outcome
        self._note(time)
        return published_items

    def _flown(self, id: int, plan: PlanAnswer) -> FlownTrajectory:
        """A planned perch as it is published."""
        contact_time = float(self._settings.contact_time)
        if self._goal.mode is Mode.SURFACE:
            return FlownTrajectory(id, plan.trajectory, AtEnd.CONTACT, contact_time)
        msg = perch_message(plan)
        return FlownTrajectory(id, from_message(msg), AtEnd(msg.at_end), contact_time, msg.recovery_start)

    def _note(self, time: float) -> None:
        now = (self._machine.phase.value, self._machine.message)
        if not self.phases or self.phases[-1][1:] != now:
            self.phases.append((time, *now))
