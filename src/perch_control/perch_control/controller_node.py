"""Node `controller`: odometry in, rotor speeds out, one command per step; trajectories, commands, services."""

from __future__ import annotations

import time
from collections import deque
from threading import Thread
from typing import Any

import numpy as np
from nav_msgs.msg import Odometry
from perch_msgs.msg import (
    ControllerCommand, ControllerStatus, ControlReference, EstimatorStatus, MotorCommand, PowerlineArray, Trajectory)
from perch_msgs.srv import SetController
from rclpy.clock import Clock, ClockType
from sensor_msgs.msg import Imu
from std_srvs.srv import Trigger

from perch_control.admission import AtEnd, Order
from perch_control.assembly import Assembly, LawNotReady
from perch_control.dry_run import dry_run
from perch_control.modes import Command, StepResult
from perch_control.nmpc import chosen_lines
from perch_control.parameters import ControllerParameters
from perch_control.ros.powerline_map import mapped_segments
from perch_core.errors import ConfigError, PerchError
from perch_core.ros import qos
from perch_core.ros.composition import composition
from perch_core.ros.conversions import seconds, to_pose, to_stamp, to_vector
from perch_core.ros.deadlines import Deadlines, durations_us
from perch_core.ros.lockstep import Participant
from perch_core.ros.node import PerchNode, spin_main
from perch_core.ros.trajectories import from_message
from perch_core.ros.wire import MotorCommandTemplate, read_imu, read_odometry, stamp_of
from perch_core.timing import CONTROL_PERIOD
from perch_core.trajectory import FlatTrajectory
from perch_core.vehicle import load_vehicle

STATUS_STEPS = 10        # 50 Hz: the mission takes controller/status at every tenth step
ESTIMATOR_STEPS = 50     # 10 Hz: estimator/status
DIAGNOSTICS_STEPS = 500  # 1 Hz
DIAGNOSTICS_PHASE = 333  # not with the status, nor with the estimator's diagnostics


class ControllerNode(PerchNode[ControllerParameters]):
    """Messages to `FlightController` and back."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("controller", ControllerParameters, self._change, **kwargs)
        vehicle = load_vehicle(self.params.vehicle)
        self._assembly = Assembly(self.params, vehicle)
        dry_run(vehicle, self.params.gain_set(vehicle.name), self.params.flight, self.params.l1)
        self._flight = self._assembly.flight
        if self._assembly.nmpc is None and self.params.controller.standby:
            Thread(target=self._assembly.build_nmpc, daemon=True).start()
        self._costs: deque[float] = deque(maxlen=DIAGNOSTICS_STEPS)
        self._deadlines = Deadlines()
        self._steps = 0
        self._unanswered: bytes | None = None  # newest IMU sample without odometry
        self._unanswered_since = 0.0

        command = MotorCommand()
        command.header.frame_id = "base_link"
        self._command = MotorCommandTemplate(command)
        self._motors = composition.publisher(self, MotorCommand, "motor_command", qos.CHAIN)
        self._references = self.create_publisher(ControlReference, "controller/reference", qos.CHAIN)
        self._status = self.create_publisher(ControllerStatus, "controller/status", qos.CHAIN)
        self._shown = ControllerStatus()
        self._shown.header.frame_id = "map"
        self._participant = Participant(self)
        self._participant.subscribe(Trajectory, "trajectory", self._receive_trajectory)
        self._participant.subscribe(Trajectory, "recovery", self._receive_recovery)
        self._participant.subscribe(ControllerCommand, "controller/command", self._receive_command)
        self._participant.chain(Imu, "imu/data_raw", self._receive_imu, raw=True, on_arrival=self._watch_imu, backlog=True)
        if self.params.nmpc.lines.any:
            self._participant.subscribe(PowerlineArray, "powerlines", self._receive_lines)
        self._participant.chain(Odometry, "odometry", self._receive_odometry, raw=True)
        if self.params.estimator_status:
            self._participant.chain(EstimatorStatus, "estimator/status", self._receive_estimator, ESTIMATOR_STEPS)
        self.create_timer(0.5, self._watch_lockstep, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self.create_service(SetController, "set_controller", self._set_controller)
        self.create_service(Trigger, "abort", self._abort)

    def _change(self, value: ControllerParameters) -> None:
        """New gains and limits count from the next step."""
        if value.vehicle != self.params.vehicle:
            raise ConfigError(self.get_name(), "vehicle", "is fixed after the start")
        self._assembly.change(value)

    # -- inputs ------------------------------------------------------------------------------------------------------

    def _receive_trajectory(self, msg: Trajectory) -> None:
        try:
            trajectory = from_message(msg)
            try:
                at_end = AtEnd(msg.at_end)
            except ValueError:
                raise PerchError(f"at_end {msg.at_end} is not one of 0..3") from None
            self._flight.follow(Order(msg.id, self._assembly.reference(trajectory), trajectory.start_time, at_end, float(msg.contact_time),
                                      float(msg.recovery_start)))
        except PerchError as error:
            self._flight.maneuvers.message = f"trajectory {msg.id} refused: {error}"
            self.get_logger().warning(self._flight.maneuvers.message)

    def _receive_recovery(self, msg: Trajectory) -> None:
        try:
            trajectory = from_message(msg)
            if isinstance(trajectory, FlatTrajectory):
                raise PerchError("a way out must carry states")
            self._flight.keep_ready(Order(msg.id, self._assembly.reference(trajectory), trajectory.start_time, AtEnd.HOLD, 0.0, 0.0))
        except PerchError as error:
            self.get_logger().warning(f"way out of trajectory {msg.id} refused: {error}")

    def _receive_command(self, msg: ControllerCommand) -> None:
        try:
            self._flight.command(Command(msg.command), msg.reason)
        except ValueError as error:  # CommandRefused, or no such command
            self._flight.maneuvers.message = str(error)
            self.get_logger().warning(f"command: {error}")

    def _receive_lines(self, msg: PowerlineArray) -> None:
        if self._assembly.nmpc is not None:
            p_WB = np.array(self._flight.maneuvers.belief[0:3])
            self._assembly.nmpc.lines(chosen_lines(mapped_segments(msg), p_WB, self.params.nmpc.lines.watched))

    def _receive_estimator(self, msg: EstimatorStatus) -> None:
        self._flight.supervisor.estimator(msg.state, float(msg.vio_age), msg.message)

    def _receive_imu(self, data: bytes) -> None:
        stamp, gyro, accel = read_imu(data)
        self._flight.imu(seconds(stamp), gyro, accel)

    def _watch_imu(self, data: bytes) -> None:
        """Odometry that has stopped altogether would stop the commands: then the IMU's samples are answered instead.

        In lockstep the vehicle waits for the estimator, however long it takes on this machine, so only the timer may
        conclude that it is gone; in real time the IMU goes on and shows it.
        """
        if seconds(stamp_of(data)) <= self._flight.maneuvers.now + CONTROL_PERIOD / 2:
            return
        if self._unanswered is None:
            self._unanswered_since = time.monotonic()
        self._unanswered = data
        if not self._participant.lockstep:
            self._answer_imu(self.params.blind_after)

    def _watch_lockstep(self) -> None:
        if self._participant.lockstep:
            self._answer_imu(self.params.blind_after_lockstep)

    def _answer_imu(self, patience: float) -> None:
        data = self._unanswered
        if data is None or (time.monotonic() - self._unanswered_since < patience and not self._flight.blind):
            return
        self._unanswered = None
        self._receive_imu(data)
        stamp = stamp_of(data)
        self._answer(stamp, self._flight.step_blind(seconds(stamp)), blind=True)

    def _receive_odometry(self, data: bytes) -> None:
        begin = time.perf_counter()
        self._unanswered = None
        stamp, p, q, v, w = read_odometry(data)
        result = self._flight.step(seconds(stamp), (*p, *v, *q, *w))
        self._costs.append(time.perf_counter() - begin)
        self._answer(stamp, result)

    # -- outputs -----------------------------------------------------------------------------------------------------

    def _answer(self, stamp: int, result: StepResult, blind: bool = False) -> None:
        self._motors.publish(self._command.fill(stamp, result.armed, result.rotor_speed))
        if not blind and self._participant.lockstep is False:
            self._deadlines.answered(stamp, time.monotonic_ns())
        self._participant.later(lambda: self._show(stamp, result))

    def _show(self, stamp: int, result: StepResult) -> None:
        """Log and publish what people and the mission want to know of a step."""
        if result.event:
            self.get_logger().info(result.event)
        # In lockstep the vehicle counts steps; the same steps carry the status in every run.
        step = self._participant.step
        index = step.index if step is not None else self._steps
        if index % STATUS_STEPS == 0:
            self._publish_status(to_stamp(stamp))
        wanted = result.setpoint is not None and index % self.params.controller.reference_period == 0
        if wanted and self._references.get_subscription_count():
            self._publish_reference(to_stamp(stamp), result)
        if index % DIAGNOSTICS_STEPS == DIAGNOSTICS_PHASE:
            self._participant.in_spare_time(lambda: self._publish_diagnostics(seconds(stamp)))
        self._steps += 1

    def _publish_status(self, stamp: Any) -> None:
        flight, maneuvers = self._flight, self._flight.maneuvers
        running = maneuvers.order
        msg = self._shown  # filled anew each time: 50 new ones a second cost more than publishing them
        msg.state, msg.controller, msg.message = int(flight.state), flight.law_name, maneuvers.message
        msg.trajectory_id, msg.trajectory_time = maneuvers.trajectory_id, float(flight.trajectory_time)
        msg.trajectory_duration = float(running.source.duration) if running else 0.0
        msg.position_error, msg.odometry_age = float(flight.position_error), float(min(flight.odometry_age, 1e6))
        msg.thrust_margin, msg.header.stamp = float(flight.margin), stamp
        self._status.publish(msg)

    def _publish_reference(self, stamp: Any, result: StepResult) -> None:
        x = result.setpoint
        msg = ControlReference(
            trajectory_id=self._flight.maneuvers.trajectory_id, pose=to_pose(x.p, result.q_C), linear_velocity=to_vector(x.v),
            linear_acceleration=to_vector(x.a), angular_velocity=to_vector(result.w_C),
            angular_acceleration=to_vector(result.dw_C), thrust=float(result.wrench[0]), moment=to_vector(result.wrench[1:4]))
        msg.header.stamp, msg.header.frame_id = stamp, "map"
        self._references.publish(msg)

    def _publish_diagnostics(self, now: float) -> None:
        flight = self._flight
        values: dict[str, Any] = {"state": flight.state.name, "controller": flight.law_name, "steps": self._steps,
                                  "odometry_age_s": float(min(flight.odometry_age, 1e6)), "rotor_ratio": flight.health.ratio}
        values |= durations_us("step", self._costs)
        if self._participant.lockstep is False:
            values |= self._deadlines.report()
        level = 2 if flight.state.name == "FAILED" else 1 if flight.health.weak or flight.state.name in ("RECOVERING", "LANDING") else 0
        self.publish_diagnostics(now, values, level, flight.maneuvers.message)

    # -- services ----------------------------------------------------------------------------------------------------

    def _set_controller(self, request: SetController.Request, response: SetController.Response) -> SetController.Response:
        try:
            self._assembly.choose(request.type, request.adaptive)
        except (LawNotReady, ConfigError) as error:
            response.success, response.message = False, str(error)
            response.error_code = 2 if isinstance(error, LawNotReady) else 1
            return response
        response.success, response.error_code, response.message = True, 0, f"{self._flight.law_name} flies"
        return response

    def _abort(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success, response.message = True, self._flight.abort()
        return response


def create(**kwargs: Any) -> ControllerNode:
    """The node, for its own process or a composed one."""
    return ControllerNode(**kwargs)


def main() -> None:
    """Entry point of the executable `controller`."""
    spin_main(create)
