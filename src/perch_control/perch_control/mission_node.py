"""Node `mission`: the Perch action, from arming to adhesion."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from perch_msgs.action import Perch
from perch_msgs.msg import ControllerCommand, ControllerStatus, EstimatorStatus, PowerlineArray, Trajectory
from rclpy.action import GoalResponse
from rclpy.task import Future
from sensor_msgs.msg import Imu

from perch_core import so3
from perch_core.covariance import largest_sigma
from perch_core.ros.conversions import pose_arrays, seconds, to_array, to_pose, to_seconds, to_stamp
from perch_core.ros.lockstep import Participant
from perch_core.ros.node import PerchNode, spin_main
from perch_core.ros.trajectories import flat_message
from perch_core.ros.wire import OdometryReading, read_imu, read_odometry, stamp_of
from perch_core.timing import CONTROL_PERIOD_NS, TICK_STEPS
from perch_control.mission import (
    ControllerState, Goal, Inputs, MissionMachine, MissionSettings, Mode, Outcome, Outputs, PlanAnswer, PlanQuery, Result, State, Target)
from perch_control.mission.parameters import MissionParameters
from perch_control.ros.goal_server import GoalServer
from perch_control.ros.planner_clients import PlannerClients, perch_message
from perch_control.ros.powerline_map import mapped_target

FEEDBACK_PERIOD = 0.1  # between messages of the goal's feedback, where nothing changes [s]
TICK = TICK_STEPS * CONTROL_PERIOD_NS  # the mission decides at 50 Hz [ns]


class MissionNode(PerchNode[MissionParameters]):
    """Messages to `MissionMachine` and back; the action server; the planner's client."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("mission", MissionParameters, self._change, **kwargs)
        self._machine = MissionMachine(self.params.mission)
        self._target: Target | None = None
        self._map: PowerlineArray | None = None
        self._goal: Goal | None = None
        self._status: ControllerStatus | None = None
        self._estimator: EstimatorStatus | None = None
        self._odometry: OdometryReading | None = None       # of the last tick
        self._imu: list[bytes] = []                         # since the last tick
        self._last_tick = -TICK
        self._told = (0.0, "", "")                          # the last feedback: time [s], phase, message
        self._pending: tuple[float, Future] | None = None   # when the answer counts, and the answer
        self._deferred: int | None = None                   # stamp of a tick that waits for the planner's answer
        self._goal_handle: Any = None
        self._held: int | None = None                       # stamp of the first tick, held until there is a goal

        self._participant = Participant(self, every=TICK_STEPS)
        self._trajectories = self._participant.publisher(Trajectory, "trajectory")
        self._ways_out = self._participant.publisher(Trajectory, "recovery")
        self._commands = self._participant.publisher(ControllerCommand, "controller/command")
        self._participant.subscribe(PoseWithCovarianceStamped, "target/pose", self._receive_target)
        self._participant.subscribe(PowerlineArray, "powerlines", self._keep("_map"))
        self._participant.chain(ControllerStatus, "controller/status", self._keep("_status"), TICK_STEPS)
        self._participant.chain(EstimatorStatus, "estimator/status", self._keep("_estimator"), 5 * TICK_STEPS)
        self._participant.chain(Imu, "imu/data_raw", self._imu.append, raw=True, backlog=True)
        self._participant.chain(Odometry, "odometry", self._receive_odometry, TICK_STEPS, raw=True, backlog=True)
        self._participant.greet()
        self._planners = PlannerClients(self)
        self._server = GoalServer(self, Perch, "perch", self._begin, self._accept)

    def _change(self, value: MissionParameters) -> None:
        self._machine.settings = value.mission

    # -- inputs ------------------------------------------------------------------------------------------------------

    def _keep(self, name: str):
        return lambda msg: setattr(self, name, msg)

    def _receive_target(self, msg: PoseWithCovarianceStamped) -> None:
        p, q = pose_arrays(msg.pose.pose)
        covariance = np.reshape(msg.pose.covariance, (6, 6))
        if not (np.isfinite(p).all() and np.isfinite(covariance).all() and abs(np.linalg.norm(q) - 1.0) < 1e-3):
            self.get_logger().warning("target/pose refused: not finite, or its quaternion is not of norm 1", throttle_duration_sec=1.0)
            return
        self._target = Target(
            to_seconds(msg.header.stamp), p, q / np.linalg.norm(q),
            position_sigma=largest_sigma(covariance[:3, :3]),
            attitude_sigma=largest_sigma(covariance[3:, 3:]))

    def _receive_odometry(self, data: bytes) -> None:
        now = stamp_of(data)
        if now - self._last_tick < TICK:
            return
        self._last_tick, self._odometry = now, read_odometry(data)
        step = self._participant.step
        if self.params.hold_for_goal and self._goal_handle is None and self._held is None and self._participant.lockstep:
            if step.index == 0:
                self._held = now  # the vehicle waits for this tick's report: the flight starts with the goal
                return
        self._tick(now)

    # -- ticks -------------------------------------------------------------------------------------------------------

    def _tick(self, stamp: int) -> None:
        now, answer = seconds(stamp), None
        if self._pending is not None:
            due, future = self._pending
            if now >= due - 1e-9:
                if future.done():
                    self._pending, answer = None, self._planners.answer(future)
                elif self._participant.lockstep:
                    self._deferred = stamp  # simulation time waits; in real time the mission goes on without an answer
                    return
        outputs = self._machine.tick(self._inputs(now, answer))
        self._imu.clear()
        self._act(now, outputs)
        self._participant.report(stamp)

    def _resume(self, _: Future) -> None:
        if self._deferred is not None:
            stamp, self._deferred = self._deferred, None
            self._tick(stamp)

    def _inputs(self, now: float, answer: PlanAnswer | None) -> Inputs:
        status, estimator = self._status, self._estimator
        return Inputs(
            time=now, state=State(*(np.array(x) for x in self._odometry[1:])),
            estimator_ready=estimator is not None and estimator.state == EstimatorStatus.RUNNING,
            controller=ControllerState(status.state) if status else ControllerState.DISARMED,
            controller_message=status.message if status else "no controller/status yet",
            trajectory_id=status.trajectory_id if status else 0,
            trajectory_time=status.trajectory_time if status else 0.0,
            target=self._present_target(), specific_force_B=np.array([read_imu(data).accel for data in self._imu]).reshape(-1, 3), plan=answer,
            cancel=self._goal_handle is not None and self._goal_handle.is_cancel_requested)

    def _present_target(self) -> Target | None:
        """The pad, or the place on the mapped line that the goal means."""
        if self._goal is None or self._goal.mode is Mode.SURFACE or self._map is None:
            return self._target if self._goal is None or self._goal.mode is Mode.SURFACE else None
        return mapped_target(self._map, self._goal, np.array(self._odometry.p_WB))

    def _act(self, now: float, outputs: Outputs) -> None:
        stamp = to_stamp(float(now))
        for command, reason in outputs.commands:
            msg = ControllerCommand(command=int(command), reason=reason)
            msg.header.stamp = stamp
            self._commands.publish(msg)
        if outputs.reference is not None:
            msg = flat_message(outputs.reference)
            msg.id, msg.at_end = outputs.trajectory_id, Trajectory.AT_END_HOLD
            self._trajectories.publish(msg)
        if outputs.perch is not None:
            msg = perch_message(outputs.perch)
            msg.id = outputs.trajectory_id
            msg.contact_time = float(self.params.mission.contact_time)
            self._trajectories.publish(msg)
        if outputs.way_out is not None:
            msg = outputs.way_out.trajectory
            msg.id = outputs.trajectory_id
            self._ways_out.publish(msg)
        if outputs.query is not None:
            self._ask(now, outputs.query)
        if self._goal_handle is not None and self._machine.phase.value != "idle":
            self._tell(now)
        if outputs.outcome is not None:
            self._finish(now, outputs.outcome)

    def _tell(self, now: float) -> None:
        """The goal's feedback: at every change, and every `FEEDBACK_PERIOD`. (Each costs as much as what the mission does at a tick.)"""
        machine = self._machine
        told = (machine.phase.value, machine.message)
        if told == self._told[1:] and now - self._told[0] < FEEDBACK_PERIOD - 1e-9:
            return
        self._told = (now, *told)
        self._goal_handle.publish_feedback(Perch.Feedback(
            phase=machine.phase.value, progress=machine.phase.progress, time_to_contact=float(machine.time_to_contact),
            message=machine.message))

    # -- planner -----------------------------------------------------------------------------------------------------

    def _ask(self, now: float, query: PlanQuery) -> None:
        future = self._planners.ask(query)
        future.add_done_callback(self._resume)
        self._pending = (now + query.latency, future)

    # -- action ------------------------------------------------------------------------------------------------------

    def _accept(self, goal: Perch.Goal) -> GoalResponse:
        if self._goal_handle is not None:
            self.get_logger().warning("goal refused: another goal is being flown")
            return GoalResponse.REJECT
        return GoalResponse.ACCEPT

    def _begin(self, handle: Any) -> None:
        problem = self._problem(handle.request, self.params.mission)
        if problem:
            handle.abort()
            self._server.finish(handle, Perch.Result(success=False, error_code=Perch.Result.BAD_GOAL, message=problem))
            return
        self._goal_handle = handle
        start = seconds(self._odometry.stamp) if self._odometry else 0.0
        self._goal = self._goal_of(handle.request)
        self._machine.start(self._goal, start)
        if self._held is not None:
            held, self._held = self._held, None
            self._tick(held)

    def _finish(self, now: float, outcome: Outcome) -> None:
        self.get_logger().info(f"{outcome.result.name.lower()}: {outcome.message}")
        if self._goal_handle is None:
            return
        handle, self._goal_handle = self._goal_handle, None
        if outcome.result is Result.PERCHED:
            handle.succeed()
        elif outcome.result is Result.CANCELLED:
            handle.canceled()
        else:
            handle.abort()
        self._server.finish(handle, Perch.Result(
            success=outcome.result is Result.PERCHED, error_code=int(outcome.result), message=outcome.message,
            contact_time=float(outcome.contact_time), end_time=now, final_pose=to_pose(self._odometry.p_WB, self._odometry.q_WB)))

    def _goal_of(self, request: Perch.Goal) -> Goal:
        settings = self.params.mission

        def given(value: float, default: float) -> float:
            return default if math.isnan(value) else value

        position = yaw = None
        if request.search_pose.header.frame_id:
            position = to_array(request.search_pose.pose.position)
            yaw = float(so3.yaw_of(so3.quat_to_matrix(pose_arrays(request.search_pose.pose)[1])))
        return Goal(
            takeoff_height=given(request.takeoff_height, settings.takeoff_height),
            search_timeout=given(request.search_timeout, settings.search_timeout), mode=Mode(request.mode),
            perch_point=to_array(request.perch_point), perch_pitch=request.perch_pitch,
            perception_aware=request.perception_aware, search_position=position, search_yaw=yaw,
            inclination_hint=None if math.isnan(request.inclination_hint) else request.inclination_hint,
            replan=request.replan, attempts=max(1, request.attempts))

    @staticmethod
    def _problem(request: Perch.Goal, settings: MissionSettings) -> str:
        """Why a goal cannot be flown, or nothing."""
        if request.mode not in tuple(Mode):
            return f"mode {request.mode} is none of MODE_SURFACE (0), MODE_POWERLINE (1), MODE_INSPECTION (2)"
        if request.mode == Mode.INSPECTION and len(settings.places) < 2:
            return f"inspection: the parameter mission.waypoints holds {len(settings.places)} waypoints, needs at least 2"
        if request.mode != Mode.SURFACE:
            if not np.isfinite(to_array(request.perch_point)).all():
                return "perch_point is not finite"
            if not 0.0 <= request.perch_pitch <= math.pi + 1e-6:
                return f"perch_pitch {request.perch_pitch:g} rad is outside [0, pi]"
        if not math.isnan(request.takeoff_height) and not 0.3 <= request.takeoff_height <= 10.0:
            return f"takeoff_height {request.takeoff_height:g} m is outside [0.3, 10]"
        if not math.isnan(request.search_timeout) and not 0.0 < request.search_timeout <= 300.0:
            return f"search_timeout {request.search_timeout:g} s is outside (0, 300]"
        if not math.isnan(request.inclination_hint) and not 0.0 <= request.inclination_hint <= math.pi:
            return f"inclination_hint {request.inclination_hint:g} rad is outside [0, pi]"
        pose = request.search_pose
        if pose.header.frame_id not in ("", "map"):
            return f"search_pose: frame_id {pose.header.frame_id!r} is not 'map'"
        if pose.header.frame_id:
            p, q = pose_arrays(pose.pose)
            if not np.isfinite(p).all() or abs(np.linalg.norm(q) - 1.0) > 1e-3:
                return "search_pose: position is not finite, or the quaternion is not of norm 1"
            if p[2] < 0.3:
                return f"search_pose: height {p[2]:g} m is below 0.3 m"
        return ""


def create(**kwargs: Any) -> MissionNode:
    """The node, alone or composed."""
    return MissionNode(**kwargs)


def main() -> None:
    """Entry point of `ros2 run perch_control mission`."""
    spin_main(create)


if __name__ == "__main__":
    main()
