"""Controller component: answers each odometry sample with a command to the vehicle; takes trajectories and commands."""

from __future__ import annotations

from dataclasses import fields, replace
from functools import lru_cache
from typing import Any

from perch_core.component import Component, Diagnostics, Emitter, Input, Output, Service, Timer
from perch_core.errors import ConfigError, PerchError
from perch_core.imu_axes import ImuAxes
from perch_core.values import (
    NANOSECONDS, STALE, AtEnd, AttitudeThrust, Command, ControlReference, ControllerCommand, ControllerStatus, EstimatorHealth,
    ImuSample, MotorCommand, OdometryState, PowerlineMap, RatesThrust, SetControllerRequest, SetControllerResponse,
    TrajectoryOrder, Transform, TriggerRequest, TriggerResponse, nanoseconds, seconds)
from perch_core.values.limits import problem
from perch_core.vehicle import load_vehicle
from perch_control.assembly import Assembly, LawNotReady
from perch_control.dry_run import dry_run
from perch_control.modes import CommandRefused, State, StepResult
from perch_control.parameters import ControllerParameters
from perch_control.reference import Setpoint
from perch_control.stamp_guard import Stamp, StampGuard

STATUS_PERIOD = 20_000_000        # of controller/status [ns]
DIAGNOSTICS_PERIOD = NANOSECONDS
DIAGNOSTICS_PHASE = 666_000_000   # not with the status [ns]
BLIND_AFTER = 80_000_000          # without odometry newer than this, IMU samples are answered; motors stop 0.1 s after the last command [ns]
LONGEST_PLAN = 60.0               # a way out that starts later does not belong to the running trajectory [s]
INPUTS_LOST_AFTER = NANOSECONDS   # without any input for so long, a restart of time is accepted in flight, too [ns]
_FIXED = ("vehicle", "sensors")   # parameters that do not change after the start
_REASON_LENGTH = 200              # characters of a reason that are passed on


class Controller(Component[ControllerParameters]):
    """Answers every odometry sample with a command; a deviation from the plan leads to a hover, a recovery or a descent.

    Loss of inputs: where odometry stops and the IMU continues, IMU samples are answered by a descent without position; where both
    stop, the watchdog continues the descent.

    Attributes:
        flight: the flight controller; replaced where time has restarted.
    """

    config_type = ControllerParameters
    changeable = tuple(field.name for field in fields(ControllerParameters) if field.name not in _FIXED)

    imu = Input(ImuSample, "imu/data_raw")
    transform = Input(Transform, "/tf_static")
    odometry = Input(OdometryState, "odometry", answered=True)
    trajectory = Input(TrajectoryOrder, "trajectory", answered=True)
    recovery = Input(TrajectoryOrder, "recovery")
    command = Input(ControllerCommand, "controller/command", answered=True)
    powerlines = Input(PowerlineMap, "powerlines")
    estimator = Input(EstimatorHealth, "estimator/status")
    motor_command = Output(MotorCommand, "motor_command")
    rates_thrust = Output(RatesThrust, "rates_thrust_command")
    attitude_thrust = Output(AttitudeThrust, "attitude_thrust_command")
    status = Output(ControllerStatus, "controller/status")
    reference = Output(ControlReference, "controller/reference")
    set_controller = Service(SetControllerRequest, SetControllerResponse, "set_controller")
    abort = Service(TriggerRequest, TriggerResponse, "abort")
    watchdog = Timer(0.02)

    def __init__(self, config: ControllerParameters) -> None:
        """
        Raises:
            ConfigError: the vehicle, the sensor file or the law does not exist.
        """
        super().__init__(config)
        vehicle = load_vehicle(config.vehicle)
        commands: dict[str, Emitter[Any]] = {"rotor_speeds": self.motor_command, "rates_and_thrust": self.rates_thrust,
                                             "attitude_and_thrust": self.attitude_thrust}
        self._to_vehicle = commands[vehicle.actuation.type]
        self._assembly = Assembly(config, vehicle)
        self._axes = ImuAxes(self.warn, config.sensors)
        self._stamps = StampGuard()
        self._silent_since: int | None = None  # the host's time of the first check of the watchdog since the last input [ns]
        self._silence = 0                      # from then to its last check [ns]
        self._map_stamp = 0                               # of the map of powerlines [ns]
        self._begin()

    def _begin(self) -> None:
        """Begin a flight and reset its counters."""
        self.flight = self._assembly.flight
        self._answered: int | None = None  # newest stamp when odometry was last answered [ns]
        self._first: int | None = None     # stamp of the first answer [ns]
        self._command_stamp = 0            # of the last command to the vehicle [ns]
        self._statuses = self._references = self._diagnoses = self._steps = 0
        self._due = 0                      # time since then at which the next periodic output is due [ns]
        self._map_received = False         # since the last diagnostics
        self._silent = False               # whether IMU or watchdog are answered, as odometry is missing

    def warm_up(self) -> None:
        """Load the compiled code, and start to build the slow laws in the background."""
        _dry_run_once(self.config)
        self._assembly.prepare_slow_laws(self.work, self.warn)

    def reconfigure(self, config: ControllerParameters) -> None:
        """Apply new gains and limits from the next step on."""
        for name in _FIXED:
            if getattr(config, name) != getattr(self.config, name):
                raise ConfigError("", name, "is fixed after the start")
        self._assembly.change(config)
        if config.controller.reference_period != self.config.controller.reference_period:
            self._references = self._due = 0  # counted in the old period
        self.config = config

    # -- sensors -----------------------------------------------------------------------------------------------------

    def on_transform(self, transform: Transform) -> None:
        """Take the pose of a frame in another one; it may be that of the IMU."""
        self._axes.add_transform(transform)

    def on_imu(self, sample: ImuSample) -> None:
        """Pass a sample to the flight controller; answer it with a command where odometry has stopped."""
        taken = self._axes.in_body(sample)
        if taken is None or not self._stamp_accepted(sample.stamp, "imu/data_raw"):
            return
        stamp, answered = sample.stamp, self._answered
        self.flight.imu(self._flight_time(stamp), taken.w_B, taken.f_B)
        if answered is None or stamp <= answered or not (self._silent or stamp - answered >= BLIND_AFTER):
            return
        if self.flight.state not in (State.DISARMED, State.FAILED, State.ATTACHED):
            self._answer_silence(stamp, "odometry has stopped: commands follow the IMU samples")

    def on_odometry(self, state: OdometryState) -> None:
        """Answer a sample in `map` with a current stamp by a command to the vehicle, even where its values are refused."""
        if state.frame != "map":
            self.warn(f"odometry: frame {state.frame!r} is not 'map': ignored", min_interval=1.0)
            return
        if not self._stamp_accepted(state.stamp, "odometry"):
            return
        self._answered, self._silent = self._stamps.newest, False
        late = self._stamps.newest - state.stamp
        why = problem(state) or (f"{late * 1e-6:.0f} ms behind the newest stamp: late" if late > BLIND_AFTER else "")
        self._answer(state.stamp, self.flight.step(self._flight_time(state.stamp), (*state.p_WB, *state.v_WB, *state.q_WB, *state.w_B),
                                                   (state.pose_covariance, state.twist_covariance), why))

    def _flight_time(self, stamp: int) -> float:
        """Return the flight's time at a stamp [s]; it goes on where the clock is set back."""
        return seconds(stamp + self._stamps.set_back)

    def _stamp_accepted(self, stamp: int, channel: str) -> bool:
        """Whether a stamp is accepted.

        If time has restarted, a new flight begins. If it has jumped ahead, or back by more than `STALE`, the vehicle descends. If the
        clock was set back by less, the flight goes on, as far as odometry does.
        """
        may_restart = not self.flight.flight_state.flying or self._silence >= INPUTS_LOST_AFTER
        before, set_back = self._stamps.newest, self._stamps.set_back
        verdict = self._stamps.check(stamp, channel, may_restart)
        if verdict is Stamp.REFUSED:
            newest = seconds(self._stamps.newest)
            self.warn(f"{channel}: stamp {seconds(stamp):.3f} s is not current (newest: {newest:.3f} s): ignored",
                      min_interval=1.0)
            return False
        self._silent_since, self._silence = None, 0
        if verdict is Stamp.RESTARTED:
            self.warn(f"{channel}: time has restarted at {seconds(stamp):.3f} s: new flight, disarmed")
            self._assembly.restart()
            self._begin()
            if self._map_stamp > stamp + STALE:  # of the time before; an old one, which may be published only once, stays valid
                self._assembly.set_lines(())
        elif verdict is Stamp.SET_BACK:
            self.warn(f"{channel}: time has been set back to {seconds(stamp):.3f} s")
            by = self._stamps.set_back - set_back
            self._answered = self._answered and self._answered - by
            self._first = self._first and self._first - by
            if before - stamp > STALE:
                self.flight.descend("time has been set back")
        elif verdict is Stamp.AHEAD:
            self.warn(f"{channel}: time has jumped ahead to {seconds(stamp):.3f} s")
            self.flight.descend("time has jumped ahead")
        return True

    # -- silence -----------------------------------------------------------------------------------------------------

    def on_watchdog(self, now: int) -> None:
        """Descend without position where neither odometry nor IMU samples arrive in flight."""
        if self._silent_since is None or now < self._silent_since:
            self._silent_since = now
        self._silence = now - self._silent_since
        if self.flight.flight_state.flying and self._silence >= BLIND_AFTER:
            self._answer_silence(self._stamps.newest + self._silence, "neither odometry nor IMU: descending by the clock")

    def _answer_silence(self, stamp: int, why: str) -> None:
        if not self._silent:
            self._silent = True
            self.warn(why)
        self._answer(stamp, self.flight.step_blind(self._flight_time(stamp)))

    # -- orders ------------------------------------------------------------------------------------------------------

    def on_trajectory(self, order: TrajectoryOrder) -> None:
        """Follow a trajectory from its start on, or report why it is refused."""
        try:
            self.flight.follow(self._assembly.order(self._in_flight_time(order)))
        except PerchError as error:
            self.flight.report_refusal(f"trajectory {order.id} refused: {error}")
            self.warn(self.flight.flight_state.message)

    def on_recovery(self, order: TrajectoryOrder) -> None:
        """Keep a way out (a planned recovery) from the trajectory with the same id."""
        try:
            if (start := order.trajectory.start_time) > seconds(self._stamps.newest) + LONGEST_PLAN:
                raise PerchError(f"it starts at {start:.1f} s, long after the running trajectory")
            way_out = order._replace(at_end=AtEnd.HOLD, contact_time=0.0, recovery_start=0.0)
            self.flight.keep_ready(self._assembly.order(self._in_flight_time(way_out)))
        except PerchError as error:
            self.warn(f"way out of trajectory {order.id} refused: {error}")

    def _in_flight_time(self, order: TrajectoryOrder) -> TrajectoryOrder:
        """Return an order that starts at the flight's time."""
        if not self._stamps.set_back:
            return order
        start = order.trajectory.start_time + seconds(self._stamps.set_back)
        return order._replace(trajectory=replace(order.trajectory, start_time=start))

    def on_command(self, command: ControllerCommand) -> None:
        """Carry out a command, or report why it is refused. A stale command is ignored."""
        if command.is_stale(self._stamps.newest):
            self.warn(f"command {command.command} of {seconds(command.stamp):.3f} s is too old: ignored")
            return
        try:
            if command.command == Command.ARM:
                self._check_arming()
            self.flight.command(Command(command.command), command.reason[:_REASON_LENGTH])
        except ValueError as error:  # CommandRefused, or no such command
            self.flight.report_refusal(str(error))
            self.warn(f"command: {error}")

    def _check_arming(self) -> None:
        """Check that a vehicle listens, and that odometry arrives: at rest, its age in `flight` does not advance without it.

        Raises:
            CommandRefused: the motors may not start.
        """
        if not self._to_vehicle.has_receivers:
            raise CommandRefused("arm is refused: no vehicle has subscribed to the commands yet")
        if self._answered is None or self.flight.state not in (State.DISARMED, State.ATTACHED):
            return
        if self._stamps.newest + self._silence - self._answered >= BLIND_AFTER:
            raise CommandRefused("arm is refused: no usable odometry")

    def on_powerlines(self, lines: PowerlineMap) -> None:
        """Pass the map to the laws that use it. The topic is latched, so an old map is valid; one from the future is ignored."""
        newest = self._stamps.newest
        if self._stamps.initialised and lines.stamp > newest + STALE:
            self.warn(f"powerlines: stamp {seconds(lines.stamp):.3f} s is in the future (newest: {seconds(newest):.3f} s): ignored",
                      min_interval=1.0)
            return
        if not self.config.nmpc.lines.any:
            return
        try:
            self._assembly.set_lines([line.segment for line in lines.lines])
            self._map_received, self._map_stamp = True, lines.stamp
        except PerchError as error:
            self.warn(f"powerlines: {error}: ignored", min_interval=1.0)

    def on_estimator(self, health: EstimatorHealth) -> None:
        """Take the estimator's health; an estimator that has diverged or coasts for too long ends the running manoeuvre."""
        newest = self._stamps.newest
        if self._stamps.initialised and abs(newest - health.stamp) > STALE:
            self.warn(f"estimator/status: stamp {seconds(health.stamp):.3f} s is not current (newest: {seconds(newest):.3f} s): ignored",
                      min_interval=1.0)
            return
        self.flight.estimator(health.state, float(health.vio_age), health.message[:_REASON_LENGTH])

    # -- services ----------------------------------------------------------------------------------------------------

    def on_set_controller(self, request: SetControllerRequest, reply) -> None:
        """Switch to another control law from the next step on."""
        try:
            self._assembly.choose(request.type, request.adaptive)
        except LawNotReady as error:
            reply(SetControllerResponse(False, 2, str(error)))
        except ConfigError as error:
            reply(SetControllerResponse(False, 1, str(error)))
        else:
            reply(SetControllerResponse(True, 0, f"{self.flight.law_name} is active"))

    def on_abort(self, request: TriggerRequest, reply) -> None:
        """End the running manoeuvre in a hover."""
        try:
            reply(TriggerResponse(True, self.flight.abort()))
        except CommandRefused as error:
            reply(TriggerResponse(False, str(error)))

    # -- outputs -----------------------------------------------------------------------------------------------------

    def _answer(self, stamp: int, result: StepResult) -> None:
        """Emit the command to the vehicle first, then the periodic outputs, on one time grid from the first answer on."""
        loop = result.loop
        self._command_stamp = sent = max(stamp, self._command_stamp)  # a vehicle ignores a command older than the one before
        if loop is None:
            self.motor_command(MotorCommand(sent, result.armed, result.rotor_speed))
        elif self._to_vehicle is self.rates_thrust:
            self.rates_thrust(RatesThrust(sent, result.armed, loop.w_B, loop.thrust))
        else:
            self.attitude_thrust(AttitudeThrust(sent, result.armed, loop.q_WB, loop.w_B, loop.thrust))
        self._steps += 1
        if result.event:
            (self.warn if self.flight.odometry_refusal else self.info)(result.event)
        now = max(stamp, self._stamps.newest)  # stamps of odometry may stand still
        if self._first is None:
            self._first = now
        if now - self._first >= self._due:
            self._emit_periodic(now, now - self._first, sent, result)

    def _emit_periodic(self, now: int, since: int, stamp: int, result: StepResult) -> None:
        """Emit the periodic outputs that are due; `since`: time since the first answer [ns]."""
        period = nanoseconds(self.config.controller.reference_period)
        if since >= self._statuses * STATUS_PERIOD:
            self._statuses = since // STATUS_PERIOD + 1
            self._emit_status(now)
        if since >= self._references * period:
            self._references = since // period + 1
            if result.setpoint is not None and self.reference.has_receivers:
                self._emit_reference(stamp, result.setpoint, result)
        if since >= self._diagnoses * DIAGNOSTICS_PERIOD + DIAGNOSTICS_PHASE:
            self._diagnoses = (since - DIAGNOSTICS_PHASE) // DIAGNOSTICS_PERIOD + 1
            self._diagnose(now)
        self._due = min(self._statuses * STATUS_PERIOD, self._references * period, self._diagnoses * DIAGNOSTICS_PERIOD + DIAGNOSTICS_PHASE)

    def _emit_status(self, stamp: int) -> None:
        flight, x = self.flight, self.flight.flight_state
        self.status(ControllerStatus(
            stamp=stamp, state=int(flight.state), controller=flight.law_name, trajectory_id=x.trajectory_id,
            trajectory_time=float(x.elapsed) if x.order else 0.0, trajectory_duration=float(x.order.source.duration) if x.order else 0.0,
            position_error=float(x.position_error), odometry_age=float(min(flight.odometry_age, 1e6)),
            thrust_margin=float(x.margin), thrust_ratio=float(flight.thrust_ratio), message=x.message))

    def _emit_reference(self, stamp: int, x: Setpoint, result: StepResult) -> None:
        self.reference(ControlReference(
            stamp, self.flight.flight_state.trajectory_id, p=x.p, q=result.q_C, v=x.v, a=x.a, w=result.w_C, dw=result.dw_C,
            thrust=float(result.wrench[0]), moment=tuple(result.wrench[1:4])))

    def _diagnose(self, stamp: int) -> None:
        flight = self.flight
        if not self._map_received:  # it may be published only once, even before odometry; the vehicle moves among its lines
            self._assembly.choose_lines()
        self._map_received = False
        values = {"state": flight.state.name, "controller": flight.law_name, "steps": self._steps,
                  "odometry_age_s": float(min(flight.odometry_age, 1e6)), "rotor_ratio": flight.health.ratio,
                  "law_failures": flight.law.failures}
        level = 2 if flight.state is State.FAILED else 1 if flight.health.weak or flight.state in (State.RECOVERING, State.LANDING) else 0
        self.diagnostics(Diagnostics(stamp, values, level, flight.flight_state.message))


@lru_cache(maxsize=4)
def _dry_run_once(params: ControllerParameters) -> None:
    """Run `dry_run` once in a process: it loads the code that all controllers share."""
    vehicle = load_vehicle(params.vehicle)
    dry_run(vehicle, params.gain_set, params.flight)
