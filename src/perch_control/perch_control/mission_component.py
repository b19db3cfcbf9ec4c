"""Mission component: executes goals of the Perch action by trajectories and commands, with decisions at 50 Hz."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from itertools import count

import numpy as np

from perch_core.component import Action, Client, Component, Diagnostics, Goal, Input, Output, Service, Timer
from perch_core.imu_axes import ImuAxes
from perch_core.values import (
    NANOSECONDS, STALE, AtEnd, ControllerCommand, ControllerStatus, EstimatorHealth, ImuSample, OdometryState, PerchFeedback, PerchGoal,
    PerchPlan, PerchPlanRequest, PerchResult, PowerlineMap, PowerlinePlan, PowerlinePlanRequest, TargetPose, TrajectoryOrder, Transform,
    TriggerRequest, TriggerResponse, nanoseconds, seconds)
from perch_control.mission.awaited import awaited, overdue, overdue_at_start
from perch_control.mission.departure import Departure
from perch_control.mission.goals import goal_of, problem_with
from perch_control.mission.machine import MissionMachine
from perch_control.mission.missions import mission_class
from perch_control.mission.moves import Moves
from perch_control.mission.parameters import MissionParameters
from perch_control.mission.pending_requests import Answer, PendingRequest, Request
from perch_control.mission.requests import flown_order, perch_request, plan_answer, powerline_request
from perch_control.mission.running_goal import DepartureGoal, RunningGoal
from perch_control.mission.targets import Targets
from perch_control.mission.values import TICK, ControllerState, Inputs, Outcome, Outputs, Phase, PlanQuery, Result, State
from perch_control.period import MeasuredPeriod
from perch_control.stamp_guard import Stamp, StampGuard

FEEDBACK_PERIOD = NANOSECONDS // 10  # where nothing changes [ns]
ODOMETRY_TIMEOUT = NANOSECONDS // 2  # without odometry for so long, the host's time is used instead [ns]
TICK_NS = nanoseconds(TICK)          # [ns]
RUNNING = 1                          # perch_msgs/EstimatorStatus
IMU_SAMPLES_MAX = 4000               # samples between two ticks that are kept
_ENDINGS = {Result.PERCHED: "succeeded", Result.CANCELLED: "cancelled"}


class Mission(Component[MissionParameters]):
    """Executes one goal at a time. Its time is the stamp of the newest odometry."""

    config_type = MissionParameters
    changeable = ("mission.",)

    imu = Input(ImuSample, "imu/data_raw", lazy=True)
    transform = Input(Transform, "/tf_static")
    odometry = Input(OdometryState, "odometry", lazy=True)
    target = Input(TargetPose, "target/pose")
    powerlines = Input(PowerlineMap, "powerlines")
    status = Input(ControllerStatus, "controller/status")
    estimator = Input(EstimatorHealth, "estimator/status")
    trajectory = Output(TrajectoryOrder, "trajectory")
    recovery = Output(TrajectoryOrder, "recovery")
    command = Output(ControllerCommand, "controller/command")
    plan_perch = Client(PerchPlanRequest, PerchPlan, "plan_perch")
    plan_way_out = Client(PerchPlanRequest, PerchPlan, "plan_way_out")
    plan_powerline = Client(PowerlinePlanRequest, PowerlinePlan, "plan_powerline")
    perch = Action(PerchGoal, PerchFeedback, PerchResult, "perch")
    depart = Service(TriggerRequest, TriggerResponse, "depart")
    tick = Timer(TICK)

    def __init__(self, config: MissionParameters) -> None:
        """
        Raises:
            ConfigError: the sensor file does not exist.
        """
        super().__init__(config)
        self._axes = ImuAxes(self.warn, config.sensors)
        self._ids = count(1)  # the controller distinguishes trajectories by them: they are unique across goals
        self._running: RunningGoal | None = None
        self._begin()

    def _begin(self) -> None:
        """Reset all inputs and moves."""
        self._stamps, self._imu_period = StampGuard(), MeasuredPeriod()
        self._moves = Moves(self.config.mission)  # `home` is kept from goal to goal
        self._forces: deque[tuple[float, ...]] = deque(maxlen=IMU_SAMPLES_MAX)
        self._odometry: OdometryState | None = None
        self._newest_imu: int | None = None  # stamp of the newest IMU sample [ns]
        self._targets = Targets()
        self._status: ControllerStatus | None = None
        self._estimator: EstimatorHealth | None = None
        self._last_odometry_stamp = self._last_odometry_time = -1  # odometry of the last tick, and the host's time then [ns]
        self._idle_ticks = 0  # since the newest odometry or the goal; they are regular although simulated time may stand still
        self._last_feedback = (-FEEDBACK_PERIOD, "", "")  # the last feedback: stamp [ns], phase, message
        self._diagnosed: int | None = None

    def reconfigure(self, config: MissionParameters) -> None:
        """Apply new settings from the next tick on."""
        self.config = config
        if self._running is not None:
            self._running.machine.reconfigure(config.mission)

    # -- inputs ------------------------------------------------------------------------------------------------------

    def on_transform(self, transform: Transform) -> None:
        """Take the pose of a frame in another one; it may be that of the IMU."""
        self._axes.add_transform(transform)

    def on_imu(self, sample: ImuSample) -> None:
        """Keep the specific force for the next tick."""
        taken = self._axes.in_body(sample)
        if taken is not None and self._stamp_accepted(sample.stamp, "imu/data_raw"):
            self._imu_period.update(seconds(sample.stamp))
            self._forces.append(taken.f_B)
            self._newest_imu = sample.stamp

    def on_odometry(self, state: OdometryState) -> None:
        """Keep the newest odometry."""
        if state.frame != "map":
            self.warn(f"odometry: frame {state.frame!r} is not 'map': ignored", min_interval=1.0)
        elif self._stamp_accepted(state.stamp, "odometry") and (self._odometry is None or state.stamp > self._odometry.stamp):
            self._odometry = state

    def _stamp_accepted(self, stamp: int, channel: str) -> bool:
        verdict = self._stamps.check(stamp, channel)
        if verdict is Stamp.REFUSED:
            newest = seconds(self._stamps.newest)
            self.warn(f"{channel}: stamp {seconds(stamp):.3f} s is not current (newest: {newest:.3f} s): ignored",
                      min_interval=1.0)
            return False
        if verdict is Stamp.RESTARTED:
            self.warn(f"{channel}: time has restarted at {seconds(stamp):.3f} s")
            if self._running is not None:
                self._finish(self._running, stamp, Outcome(Result.TRACKING_LOST, "time has restarted"))
            self._begin()
            self._stamps.check(stamp, channel)
        return True

    def on_target(self, pose: TargetPose) -> None:
        """Keep the newest pose of the pad."""
        if problem := self._targets.take_pad(pose, self._odometry, self._stamps.newest):
            self.warn(f"target/pose refused: {problem}", min_interval=1.0)

    def on_powerlines(self, lines: PowerlineMap) -> None:
        """Keep the newest map."""
        if problem := self._targets.take_lines(lines, self._stamps.newest if self._stamps.initialised else None):
            self.warn(f"powerlines refused: {problem}", min_interval=1.0)

    def on_status(self, status: ControllerStatus) -> None:
        """Keep the controller's state."""
        if not self._outdated(status, self._status, "controller/status"):
            self._status = status

    def on_estimator(self, health: EstimatorHealth) -> None:
        """Keep the estimator's state."""
        if not self._outdated(health, self._estimator, "estimator/status"):
            self._estimator = health

    def _outdated(self, state: ControllerStatus | EstimatorHealth, previous: ControllerStatus | EstimatorHealth | None,
                  channel: str) -> bool:
        """Whether a message is older than the previous one, or more than `STALE` behind the sensors. It may be ahead of the
        sensors, as it is published without them, too. A previous message that is ahead by more than `STALE` does not count."""
        overtaken = previous is not None and 0 < previous.stamp - state.stamp <= STALE
        if overtaken or state.stamp < self._stamps.newest - STALE:
            problem = "older than the one before" if overtaken else "not current"
            self.warn(f"{channel}: stamp {seconds(state.stamp):.3f} s is {problem}: ignored", min_interval=1.0)
            return True
        return False

    # -- ticks -------------------------------------------------------------------------------------------------------

    def on_tick(self, now: int) -> None:
        """Decide where there is newer odometry than at the last tick, or none for `ODOMETRY_TIMEOUT`."""
        self._idle_ticks += 1
        if self._odometry is None:
            if self._running is not None:
                self._wait_for_odometry(self._running, now)
            return
        stamp = self._odometry.stamp
        if stamp != self._last_odometry_stamp or now < self._last_odometry_time:
            self._last_odometry_stamp, self._last_odometry_time, self._idle_ticks = stamp, now, 0
        elif now - self._last_odometry_time >= ODOMETRY_TIMEOUT:
            stamp += now - self._last_odometry_time
        else:
            if self._running is not None and (text := overdue(self._idle_ticks * TICK_NS, 0, {"/clock": None, "odometry": None})):
                self._running.overdue = text
                self._publish_feedback(self._running, stamp)
            return
        if self._running is not None:
            self._decide(self._running, stamp, self._odometry)
        self._forces.clear()
        if self._diagnosed is None or stamp - self._diagnosed >= NANOSECONDS:
            self._diagnosed = stamp
            phase, message = ("idle", "no goal") if self._running is None else (self._running.machine.phase.value, self._running.message)
            self.diagnostics(Diagnostics(stamp, {"phase": phase}, 0, message))

    def _wait_for_odometry(self, running: RunningGoal, now: int) -> None:
        if running.waiting_since is None or now < running.waiting_since:
            running.waiting_since = now
        running.overdue = overdue_at_start(now - running.waiting_since, self._idle_ticks * TICK_NS, self._newest(running))
        self._publish_feedback(running, now)
        if running.goal.cancel_requested:
            self._finish(running, 0, Outcome(Result.CANCELLED, "cancelled on the ground"))
        elif now - running.waiting_since > nanoseconds(self.config.mission.arming_timeout):
            self._finish(running, 0, Outcome(Result.TIMEOUT, f"no odometry within {self.config.mission.arming_timeout:g} s"))

    def _decide(self, running: RunningGoal, stamp: int, odometry: OdometryState) -> None:
        status = self._status
        if status is not None and odometry.stamp - status.stamp > STALE:  # it answers every sample, whatever its state
            self._finish(running, stamp, Outcome(Result.TRACKING_LOST, f"the controller is silent: no controller/status for {seconds(STALE):g} s"))
            return
        time = seconds(stamp)
        if not running.started:
            running.started = True
            running.machine.start(goal_of(running.goal.value, self.config.mission), time)
        plan, way_out = running.pending, running.way_out
        running.overdue = overdue(stamp, nanoseconds(running.machine.since), self._newest(running))
        inputs = self._inputs(running, time, odometry)
        if plan is not None and stamp >= plan.due and plan.answer is not None:
            running.pending = None
            inputs = replace(inputs, plan=plan_answer(plan.answer))
        if way_out is not None and stamp >= way_out.due and way_out.answer is not None:
            running.way_out = None
            inputs = replace(inputs, way_out=plan_answer(way_out.answer))
        self._act(running, stamp, running.machine.tick(inputs))

    def _inputs(self, running: RunningGoal, time: float, x: OdometryState) -> Inputs:
        status, estimator = self._status, self._estimator
        state = State(np.array(x.p_WB), np.array(x.q_WB), np.array(x.v_WB), np.array(x.w_B))
        ready = estimator is not None and estimator.state == RUNNING and nanoseconds(time) - estimator.stamp <= STALE
        return Inputs(
            time=time, state=state, estimator_ready=ready,
            controller=ControllerState(status.state) if status else ControllerState.DISARMED,
            controller_message=status.message if status else "no controller/status yet",
            trajectory_id=status.trajectory_id if status else 0,
            target=running.machine.target(self._targets.pad(x), self._targets.lines, state.p_WB),
            specific_force_B=np.array(self._forces).reshape(-1, 3),
            cancel=running.goal.cancel_requested, imu_period=self._imu_period.value,
            controller_time=seconds(status.stamp) if status else -math.inf)

    def _newest(self, running: RunningGoal) -> dict[str, int | None]:
        return awaited(running, self._newest_imu, self._odometry, self._estimator, self._status, self._targets)

    def _act(self, running: RunningGoal, stamp: int, outputs: Outputs) -> None:
        for command, reason in outputs.commands:
            self.command(ControllerCommand(stamp, int(command), reason))
        if outputs.reference is not None:
            self.trajectory(TrajectoryOrder.of(outputs.trajectory_id, outputs.reference))
        if outputs.perch is not None:
            self.trajectory(flown_order(outputs.trajectory_id, outputs.perch, float(self.config.mission.contact_time)))
        if outputs.way_out is not None:
            self.recovery(TrajectoryOrder.of(outputs.trajectory_id, outputs.way_out.trajectory, AtEnd.HOLD))
        if outputs.query is not None:
            self._request_plan(running, stamp, outputs.query)
        if outputs.way_out_query is not None:
            self._request_plan(running, stamp, outputs.way_out_query)
        if running.machine.phase.value != "idle":
            self._publish_feedback(running, stamp)
        if outputs.outcome is not None:
            self._finish(running, stamp, outputs.outcome)

    def _publish_feedback(self, running: RunningGoal, stamp: int) -> None:
        """Publish the goal's feedback at every change, and every `FEEDBACK_PERIOD`."""
        phase = running.machine.phase if running.started else Phase.ARMING
        content = (phase.value, running.message)
        if content == self._last_feedback[1:] and 0 <= stamp - self._last_feedback[0] < FEEDBACK_PERIOD:
            return
        self._last_feedback = (stamp, *content)
        running.goal.feedback(PerchFeedback(content[0], phase.progress, float(running.machine.time_to_contact), content[1]))

    # -- planners ----------------------------------------------------------------------------------------------------

    def _request_plan(self, running: RunningGoal, stamp: int, query: PlanQuery) -> None:
        surface = not query.target.lines
        channel = "plan_powerline" if not surface else "plan_way_out" if query.recovery else "plan_perch"
        request = perch_request(query, self._status.thrust_ratio if self._status else 0.0) if surface else powerline_request(query)
        pending = PendingRequest(channel, stamp, stamp + nanoseconds(query.latency), request)
        if channel == "plan_way_out":
            running.way_out = pending
        else:
            running.pending = pending
        getattr(self, channel)(request, pending.due)

    def _keep_answer(self, request: Request, answer: Answer) -> None:
        """Keep an answer until it is due; one to a request that is no longer pending is dropped."""
        for pending in () if self._running is None else (self._running.pending, self._running.way_out):
            if pending is not None and pending.request is request:
                pending.answer = answer

    on_plan_perch = on_plan_way_out = on_plan_powerline = _keep_answer

    # -- goals -------------------------------------------------------------------------------------------------------

    def on_perch(self, goal: Goal) -> str:
        """Accept a goal, or return why it is rejected; one that cannot be flown is aborted at once, with the reason."""
        if self._running is not None:
            self.warn("goal refused: another goal is being flown")
            return "another goal is being flown"
        problem = problem_with(goal.value, self.config.mission)
        if problem:
            self.warn(f"goal refused: {problem}")
            goal.finish("aborted", PerchResult(False, int(Result.BAD_GOAL), problem))
            return ""
        self._take(goal, mission_class(goal.value.mode))
        return ""

    def on_depart(self, request: TriggerRequest, reply: Callable[[TriggerResponse], None]) -> None:
        """Leave the surface or wire that carries the vehicle; answered once the vehicle hovers, or the departure has failed."""
        if self._running is not None:
            reply(TriggerResponse(False, "a goal is being flown"))
        else:
            self._take(DepartureGoal(reply), Departure)

    def _take(self, goal: Goal, kind: type[MissionMachine]) -> None:
        self._running, self._idle_ticks = RunningGoal(goal, kind(self.config.mission, self._ids, self._moves)), 0

    def _finish(self, running: RunningGoal, stamp: int, outcome: Outcome) -> None:
        message = running.with_overdue(outcome.message) if outcome.result is not Result.PERCHED else outcome.message
        self.info(f"{outcome.result.name.lower()}: {message}")
        self._running, x = None, self._odometry
        pose = {} if x is None else {"final_position": tuple(x.p_WB), "final_attitude": tuple(x.q_WB)}
        running.goal.finish(_ENDINGS.get(outcome.result, "aborted"), PerchResult(
            outcome.result is Result.PERCHED, int(outcome.result), message, float(outcome.contact_time), seconds(stamp), **pose))
