"""The mission: goals of the Perch action to trajectories and commands, decided at 50 Hz."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from itertools import count
from typing import Any

import numpy as np

from perch_core.component import Action, Client, Component, Diagnostics, Goal, Input, Output, Service, Unavailable, Wake
from perch_core.covariance import drift, largest_sigma
from perch_core.errors import PerchError
from perch_core.values import (
    NANOSECONDS, Ask, AtEnd, ControllerCommand, ControllerStatus, Done, EstimatorHealth, ImuSample, OdometryState, PerchFeedback, PerchGoal, PerchPlan,
    PerchPlanRequest, PerchResult, PowerlineMap, PowerlinePlan, PowerlinePlanRequest, TargetPose, TrajectoryOrder, nanoseconds, seconds)
from perch_control.mission.departure import Departure
from perch_control.mission.goals import goal_of, problem_with
from perch_control.mission.machine import MissionMachine
from perch_control.mission.missions import mission_class
from perch_control.mission.moves import Moves
from perch_control.mission.parameters import MissionParameters
from perch_control.mission.requests import flown_order, perch_request, plan_answer, powerline_request
from perch_control.mission.values import (
    TICK, ControllerState, Inputs, Mode, Outcome, Outputs, PlanAnswer, PlanQuery, Result, State, Target)
from perch_control.period import MeasuredPeriod
from perch_control.stamp_guard import Stamp, StampGuard

FEEDBACK_PERIOD = NANOSECONDS // 10  # where nothing changes [ns]
SILENCE = NANOSECONDS // 2           # without odometry for so long, the host's time goes on in its place [ns]
FORGOTTEN = 15 * NANOSECONDS         # a planner that has not answered for so long does not answer any more [ns]
AHEAD = NANOSECONDS // 10            # a target's stamp is no more than this ahead of the newest sample [ns]
STALE = NANOSECONDS                  # of another time [ns]
RUNNING = 1                          # perch_msgs/EstimatorStatus
IMU_MOST = 4000                      # samples between two ticks that are kept
_ENDINGS = {Result.PERCHED: "succeeded", Result.CANCELLED: "cancelled"}


@dataclass
class _Asked:
    """A request under way: when it was made and when its answer counts [ns], the plan's start [s], the answer."""

    made: int
    due: int
    start: float
    answer: PerchPlan | PowerlinePlan | Unavailable | None = None


class _Departing:
    """A departure as the mission sees goals: its end answers the request."""

    value, cancel_requested = PerchGoal(mode=Mode.POWERLINE), False  # the planner that is asked is that of wires

    def __init__(self, reply: Callable[[Done], None]) -> None:
        self._reply = reply

    def feedback(self, value: PerchFeedback) -> None:
        """Nobody asked for it."""

    def finish(self, ending: str, result: PerchResult) -> None:
        """Answer."""
        self._reply(Done(result.success, result.message))


class Mission(Component[MissionParameters]):
    """One goal at a time. Its time is the stamp of the newest odometry."""

    config_type = MissionParameters
    changeable = ("",)

    imu = Input(ImuSample, "imu/data_raw", lazy=True)
    odometry = Input(OdometryState, "odometry", lazy=True)
    target = Input(TargetPose, "target/pose")
    powerlines = Input(PowerlineMap, "powerlines")
    status = Input(ControllerStatus, "controller/status")
    estimator = Input(EstimatorHealth, "estimator/status")
    trajectory = Output(TrajectoryOrder, "trajectory")
    recovery = Output(TrajectoryOrder, "recovery")
    command = Output(ControllerCommand, "controller/command")
    plan_perch = Client(PerchPlanRequest, PerchPlan, "plan_perch")
    plan_powerline = Client(PowerlinePlanRequest, PowerlinePlan, "plan_powerline")
    perch = Action(PerchGoal, PerchFeedback, PerchResult, "perch")
    depart = Service(Ask, Done, "depart")
    tick = Wake(TICK)

    def __init__(self, config: MissionParameters) -> None:
        super().__init__(config)
        self._ids = count(1)  # the controller tells trajectories apart by them: they go on from goal to goal
        self._goal: Goal | None = None
        self._machine: MissionMachine | None = None
        self._begin()

    def _begin(self) -> None:
        """Nothing is known."""
        self._stamps, self._imu_period = StampGuard(), MeasuredPeriod()
        self._moves = Moves(self.config.mission)  # home stays from goal to goal
        self._forces: deque[tuple[float, ...]] = deque(maxlen=IMU_MOST)
        self._odometry: OdometryState | None = None
        self._pad: tuple[TargetPose, np.ndarray] | None = None  # and the covariance of the odometry when it came, shape (6, 6)
        self._map: PowerlineMap | None = None
        self._status: ControllerStatus | None = None
        self._estimator: EstimatorHealth | None = None
        self._asked: dict[str, list[_Asked]] = {"plan_perch": [], "plan_powerline": []}
        self._pending: _Asked | None = None
        self._used = self._heard = -1          # odometry of the last tick, and the host's time then [ns]
        self._waiting_since: int | None = None  # the host's time since which a goal waits for odometry [ns]
        self._started = False                   # the machine has taken the goal
        self._told = (-FEEDBACK_PERIOD, "", "")  # the last feedback: stamp [ns], phase, message
        self._diagnosed: int | None = None

    def reconfigure(self, config: MissionParameters) -> None:
        """New settings count from the next tick on."""
        self.config = config
        if self._machine is not None:
            self._machine.reconfigure(config.mission)

    # -- inputs ------------------------------------------------------------------------------------------------------

    def on_imu(self, sample: ImuSample) -> None:
        """Keep the specific force for the next tick."""
        if why := sample.axes_problem:
            self.warn(f"imu/data_raw: {why}: ignored", every=1.0)
        elif self._believed(sample.stamp, "imu/data_raw"):
            self._imu_period.update(seconds(sample.stamp))
            self._forces.append(sample.f_B)

    def on_odometry(self, state: OdometryState) -> None:
        """Keep the newest."""
        if state.frame != "map":
            self.warn(f"odometry: frame {state.frame!r} is not 'map': ignored", every=1.0)
        elif self._believed(state.stamp, "odometry") and (self._odometry is None or state.stamp > self._odometry.stamp):
            self._odometry = state

    def _believed(self, stamp: int, channel: str) -> bool:
        verdict = self._stamps.judge(stamp)
        if verdict is Stamp.REFUSED:
            newest = seconds(self._stamps.newest)
            self.warn(f"{channel}: stamp {seconds(stamp):.3f} s is not of the present ({newest:.3f} s): ignored", every=1.0)
            return False
        if verdict is Stamp.ANEW:
            self.warn(f"{channel}: stamps go on from {seconds(stamp):.3f} s: starting anew")
            if self._goal is not None:
                self._finish(stamp, Outcome(Result.TRACKING_LOST, "time has begun anew"))
            self._begin()
            self._stamps.judge(stamp)
        return True

    def on_target(self, pose: TargetPose) -> None:
        """Keep the newest pose of the pad."""
        problem = ""
        if self._odometry is None:
            problem = "there is no odometry yet"
        elif pose.stamp > self._stamps.newest + AHEAD:
            problem = "its stamp is in the future"
        elif self._pad is not None and pose.stamp < self._pad[0].stamp:
            problem = "it is older than the newest"
        if problem:
            self.warn(f"target/pose refused: {problem}", every=1.0)
            return
        self._pad = pose, self._odometry.pose_covariance

    def _pad_now(self) -> Target | None:
        """The pad as it stands to the vehicle: what the odometry has drifted since it was seen makes it less certain."""
        if self._pad is None:
            return None
        (pose, before), x = self._pad, self._odometry
        covariance = pose.covariance + drift(x.pose_covariance, before, pose.p_WS - x.p_WB)
        return Target(seconds(pose.stamp), pose.p_WS, pose.q_WS / np.linalg.norm(pose.q_WS), largest_sigma(covariance[:3, :3]),
                      largest_sigma(covariance[3:, 3:]))

    def on_powerlines(self, lines: PowerlineMap) -> None:
        """Keep the newest map."""
        newest = self._stamps.newest
        try:
            if newest is None or lines.stamp > newest + AHEAD:
                raise PerchError("its stamp is in the future")
            if self._map is not None and lines.stamp < self._map.stamp:
                raise PerchError("it is older than the newest")
            for line in lines.lines:
                _ = line.segment  # raises where it is none
        except PerchError as error:
            self.warn(f"powerlines refused: {error}", every=1.0)
            return
        self._map = lines

    def on_status(self, status: ControllerStatus) -> None:
        """Keep the controller's state."""
        if self._of_another_time(status.stamp):
            self.warn(f"controller/status: of {seconds(status.stamp):.3f} s: ignored", every=1.0)
        else:
            self._status = status

    def on_estimator(self, health: EstimatorHealth) -> None:
        """Keep the estimator's state."""
        if self._of_another_time(health.stamp):
            self.warn(f"estimator/status: of {seconds(health.stamp):.3f} s: ignored", every=1.0)
        else:
            self._estimator = health

    def _of_another_time(self, stamp: int) -> bool:
        """What goes on while sensors are silent may be ahead of them, but not behind."""
        return self._stamps.newest is not None and stamp < self._stamps.newest - STALE

    # -- ticks -------------------------------------------------------------------------------------------------------

    def on_tick(self, now: int) -> None:
        """Decide, where there is odometry that is newer than at the last tick, or none at all for a while."""
        if self._odometry is None:
            self._wait_for_odometry(now)
            return
        stamp = self._odometry.stamp
        if stamp != self._used or now < self._heard:
            self._used, self._heard = stamp, now
        elif now - self._heard >= SILENCE:
            stamp += now - self._heard
        else:
            return
        self._decide(stamp)
        if self._diagnosed is None or stamp - self._diagnosed >= NANOSECONDS:
            self._diagnosed = stamp
            phase = self._machine.phase.value if self._machine is not None else "idle"
            message = self._machine.message if self._machine is not None else "no goal"
            self.diagnostics(Diagnostics(stamp, {"phase": phase}, 0, message))

    def _wait_for_odometry(self, now: int) -> None:
        if self._goal is None:
            return
        if self._waiting_since is None or now < self._waiting_since:
            self._waiting_since = now
        if self._goal.cancel_requested:
            self._finish(0, Outcome(Result.CANCELLED, "cancelled on the ground"))
        elif now - self._waiting_since > nanoseconds(self.config.mission.arming_timeout):
            self._finish(0, Outcome(Result.TIMEOUT, f"no odometry within {self.config.mission.arming_timeout:g} s"))

    def _decide(self, stamp: int) -> None:
        machine, status = self._machine, self._status
        if machine is None:
            self._forces.clear()
            return
        if status is not None and self._odometry.stamp - status.stamp > STALE:  # it answers every sample, whatever its state
            self._finish(stamp, Outcome(Result.TRACKING_LOST, f"the controller is silent: no controller/status for {seconds(STALE):g} s"))
            return
        time, answer, pending = seconds(stamp), None, self._pending
        if not self._started:
            self._started = True
            machine.start(goal_of(self._goal.value, self.config.mission), time)
        if pending is not None and stamp >= pending.due and pending.answer is not None:
            self._pending, answer = None, plan_answer(pending.answer)
        outputs = machine.tick(self._inputs(time, answer))
        self._forces.clear()
        self._act(stamp, outputs)

    def _inputs(self, time: float, answer: PlanAnswer | None) -> Inputs:
        status, estimator, x = self._status, self._estimator, self._odometry
        state = State(np.array(x.p_WB), np.array(x.q_WB), np.array(x.v_WB), np.array(x.w_B))
        return Inputs(
            time=time, state=state, estimator_ready=estimator is not None and estimator.state == RUNNING,
            controller=ControllerState(status.state) if status else ControllerState.DISARMED,
            controller_message=status.message if status else "no controller/status yet",
            trajectory_id=status.trajectory_id if status else 0, trajectory_time=status.trajectory_time if status else 0.0,
            target=self._machine.target(self._pad_now(), self._map, state.p_WB), specific_force_B=np.array(self._forces).reshape(-1, 3), plan=answer,
            cancel=self._goal.cancel_requested, imu_period=self._imu_period.value)

    def _act(self, stamp: int, outputs: Outputs) -> None:
        for command, reason in outputs.commands:
            self.command(ControllerCommand(stamp, int(command), reason))
        if outputs.reference is not None:
            self.trajectory(TrajectoryOrder.of(outputs.trajectory_id, outputs.reference))
        if outputs.perch is not None:
            self.trajectory(flown_order(outputs.trajectory_id, outputs.perch, float(self.config.mission.contact_time)))
        if outputs.way_out is not None:
            self.recovery(TrajectoryOrder.of(outputs.trajectory_id, outputs.way_out.trajectory, AtEnd.HOLD))
        if outputs.query is not None:
            self._ask(stamp, outputs.query)
        if self._machine.phase.value != "idle":
            self._tell(stamp)
        if outputs.outcome is not None:
            self._finish(stamp, outputs.outcome)

    def _tell(self, stamp: int) -> None:
        """The goal's feedback: at every change, and every `FEEDBACK_PERIOD`."""
        machine = self._machine
        words = (machine.phase.value, machine.message)
        if words == self._told[1:] and stamp - self._told[0] < FEEDBACK_PERIOD:
            return
        self._told = (stamp, *words)
        self._goal.feedback(PerchFeedback(machine.phase.value, machine.phase.progress, float(machine.time_to_contact), machine.message))

    # -- planners ----------------------------------------------------------------------------------------------------

    def _ask(self, stamp: int, query: PlanQuery) -> None:
        surface = self._goal.value.mode == Mode.SURFACE
        request: Any = perch_request(query) if surface else powerline_request(query)
        asked = self._pending = _Asked(stamp, stamp + nanoseconds(query.latency), seconds(request.start))
        under_way = self._asked["plan_perch" if surface else "plan_powerline"]
        under_way[:] = [other for other in under_way if stamp - other.made < FORGOTTEN] + [asked]
        (self.plan_perch if surface else self.plan_powerline)(request, asked.due)

    def on_plan_perch(self, plan: PerchPlan | Unavailable) -> None:
        """Keep it until it counts."""
        self._take_answer(self._asked["plan_perch"], plan)

    def on_plan_powerline(self, plan: PowerlinePlan | Unavailable) -> None:
        """Keep it until it counts."""
        self._take_answer(self._asked["plan_powerline"], plan)

    @staticmethod
    def _take_answer(under_way: list[_Asked], plan: PerchPlan | PowerlinePlan | Unavailable) -> None:
        """An answer belongs to the request for its start; one without a trajectory to the oldest under way."""
        if not under_way:
            return
        start = None if isinstance(plan, Unavailable) or plan.trajectory is None else plan.trajectory.start_time
        asked = next((other for other in under_way if other.start == start), under_way[0])
        under_way.remove(asked)
        asked.answer = plan

    # -- goals -------------------------------------------------------------------------------------------------------

    def on_perch(self, goal: Goal) -> str:
        """Take a goal; one that cannot be flown ends at once, with its reason."""
        if self._goal is not None:
            self.warn("goal refused: another goal is being flown")
            return "another goal is being flown"
        problem = problem_with(goal.value, self.config.mission)
        if problem:
            self.warn(f"goal refused: {problem}")
            goal.finish("aborted", PerchResult(False, int(Result.BAD_GOAL), problem))
            return ""
        self._take(goal, mission_class(goal.value.mode))
        return ""

    def on_depart(self, request: Ask, reply: Callable[[Done], None]) -> None:
        """Leave what carries the vehicle; answered when it hovers, or cannot."""
        if self._goal is not None:
            reply(Done(False, "a goal is being flown"))
        else:
            self._take(_Departing(reply), Departure)

    def _take(self, goal: Goal, kind: type[MissionMachine]) -> None:
        self._goal, self._started, self._pending, self._waiting_since = goal, False, None, None
        self._machine = kind(self.config.mission, self._ids, self._moves)

    def _finish(self, stamp: int, outcome: Outcome) -> None:
        self.info(f"{outcome.result.name.lower()}: {outcome.message}")
        goal, self._goal, self._machine, self._pending = self._goal, None, None, None
        x = self._odometry
        pose = {} if x is None else {"final_position": tuple(x.p_WB), "final_attitude": tuple(x.q_WB)}
        goal.finish(_ENDINGS.get(outcome.result, "aborted"), PerchResult(
            outcome.result is Result.PERCHED, int(outcome.result), outcome.message, float(outcome.contact_time), seconds(stamp), **pose))
