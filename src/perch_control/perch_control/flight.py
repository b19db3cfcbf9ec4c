"""Flight controller without ROS: takes orders, and answers each odometry sample by a `step`, under a supervisor."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from perch_core.values import Command
from perch_core.vehicle import ControlGains, Vehicle
from perch_control import actuation
from perch_control.admission import AtEnd, Order, TrajectoryRefused, check_joints, check_start
from perch_control.estimator_verdict import EstimatorVerdict
from perch_control.flight_settings import FlightSettings
from perch_control.flight_state import FlightState
from perch_control.guidance import Hold
from perch_control.l1 import L1Augmentation
from perch_control.law import Law
from perch_control.maneuvers import (
    attached, descending, entered, following, hover_after_jump, land_on_command, landing, motors_off, recovered, stopped)
from perch_control.modes import CommandRefused, State, StepResult
from perch_control.monitors import DOWN_TIME
from perch_control.period import MeasuredPeriod
from perch_control.resting import check_arming, idling, off_perch
from perch_control.rotor_health import RotorHealth
from perch_control.schedule import Schedule
from perch_control.sensor_inputs import SensorInputs
from perch_control.supervisor import Supervisor, committed
from perch_control.thrust_model import ThrustModel

_MARGIN_PERCH = 0.15  # a perch is refused where the mean thrust margin in hover is less: one rotor is far weaker


class FlightController:
    """Takes orders, checks odometry, supervises the flight, and evaluates the control law.

    Attributes:
        flight_state: state of the flight; each input and each step replaces it.
        law, compensator: control law and L1 augmentation in use; compensator None: without L1.
        gains, settings: gains and limits in use; `use` replaces them.
    """

    def __init__(self, vehicle: Vehicle, law: Law, gains: ControlGains, settings: FlightSettings) -> None:
        self.law, self.gains, self.settings = law, gains, settings
        self.flight_state = FlightState.disarmed(vehicle)
        self.supervisor = Supervisor(vehicle, settings)
        self.compensator: L1Augmentation | None = None
        self._schedule = Schedule()
        self._estimator_verdict = EstimatorVerdict()  # on its last status
        self._thrust = ThrustModel(vehicle)
        self._inputs = SensorInputs()
        self._period = MeasuredPeriod()
        law.begin()

    def use(self, law: Law, gains: ControlGains, settings: FlightSettings) -> None:
        """Use another law, or the same one with other gains and limits, from the next step on."""
        if law is not self.law:
            law.begin()
        self.law, self.gains, self.settings = law, gains, settings
        law.set_vehicle(self.vehicle)
        law.set_period(self._period.value)
        self.supervisor.settings = settings
        self.supervisor.restart(self.state)

    @property
    def state(self) -> State:
        """State of the controller, as published."""
        return self.flight_state.mode

    @property
    def vehicle(self) -> Vehicle:
        """The vehicle model in use."""
        return self.flight_state.vehicle

    @property
    def odometry_age(self) -> float:
        """Age of the last accepted odometry sample [s]."""
        return self._inputs.age

    @property
    def odometry_refusal(self) -> str:
        """Why the last odometry sample was refused; empty: it was accepted."""
        return self._inputs.refusal

    @property
    def health(self) -> RotorHealth:
        """Health of the rotors."""
        return self._thrust.health

    @property
    def thrust_ratio(self) -> float:
        """Thrust / mass that would be used for a perch, over the vehicle file's."""
        return self._thrust.ratio(self.compensator)

    @property
    def law_name(self) -> str:
        """Name of the control law in use, with `+l1` where it is augmented."""
        return self.law.name + ("+l1" if self.compensator is not None else "")

    # -- orders ------------------------------------------------------------------------------------------------------

    def command(self, command: Command, reason: str = "") -> None:
        """Carry out a command.

        Raises:
            CommandRefused: the command is not possible in the present state.
        """
        self.flight_state = COMMANDS[command](self, self.flight_state, f": {reason}" if reason else "")
        if not self.flight_state.flying and command is not Command.ARM:
            self._schedule.clear()

    def _kill(self, x: FlightState, why: str) -> FlightState:
        return motors_off(x, State.FAILED, f"killed{why}")

    def _attach(self, x: FlightState, why: str) -> FlightState:
        if not x.state_estimate:
            raise CommandRefused("attached is refused: no usable odometry yet")
        if x.mode is State.FAILED:
            raise CommandRefused(f"attached is refused: {x.message}; disarm first")
        return attached(x, f"attached, motors off{why}")

    def _disarm(self, x: FlightState, why: str) -> FlightState:
        if x.flying:
            raise CommandRefused(f"disarm is refused in flight ({x.mode.name.lower()}); land first, or kill")
        return motors_off(x, State.DISARMED, f"disarmed{why}")

    def _land(self, x: FlightState, why: str) -> FlightState:
        _check_flying(x, "land")
        way_out = self._schedule.leave_by_way_out(x, f"landing{why}") if x.mode is State.TRACKING else None
        if way_out is None:
            return land_on_command(x, f"landing{why}", self.settings.land_speed)
        return way_out._replace(land_requested=True)

    def _hover(self, x: FlightState, why: str) -> FlightState:
        _check_flying(x, "hover")
        if x.mode is State.RECOVERING:  # it ends in a hover, and must not be cut short
            return x._replace(land_requested=False)
        return self._end_maneuver(x._replace(land_requested=False), f"hover{why}")

    def _arm(self, x: FlightState, why: str) -> FlightState:
        if x.mode is State.ARMED or x.flying:
            return x
        check_arming(x, self._inputs, self._thrust.measured_specific_thrust, self.settings.odometry_timeout)
        x = self._thrust.reset(x, self.law, self.compensator)
        if x.mode is State.ATTACHED:
            return recovered(x, "leaving the surface or wire")
        return entered(x, State.ARMED, "armed")._replace(start=x.now, rotors=x.rotors.turning(x.vehicle.speed_min),
                                                         ground=x.state_estimate[2])

    def follow(self, order: Order) -> None:
        """Accept a trajectory; it starts at its stamp and replaces the running one there.

        Raises:
            TrajectoryRefused: the trajectory may not be flown.
        """
        x, problem = self.flight_state, self._estimator_verdict.problem
        if self.odometry_age > self.settings.odometry_timeout:
            raise TrajectoryRefused("no usable odometry")
        if self._schedule.leaving(x) or x.land_requested:
            raise TrajectoryRefused("the running manoeuvre is about to be left")
        if off := off_perch(x):
            raise TrajectoryRefused(off)
        if x.mode is State.ATTACHED:
            x = self.flight_state = self._thrust.reset(x, self.law, self.compensator)
        elif x.mode is State.ARMED and problem:
            raise TrajectoryRefused(problem)
        elif x.mode not in (State.ARMED, State.TRACKING, State.HOVERING):
            raise TrajectoryRefused(f"the vehicle is {x.mode.name.lower()}, not armed and ready")
        if not x.accepts(order):
            raise TrajectoryRefused("the vehicle is being braked to a hover")
        if x.mode is State.HOVERING and order.at_end is not AtEnd.HOLD and x.spare < _MARGIN_PERCH:
            raise TrajectoryRefused(f"the thrust margin in hover is {x.spare:.2f}; a perch needs {_MARGIN_PERCH:g}")
        check_joints(order.source.trajectory)
        check_start(order, x.now, x.expected(max(order.start, x.now)))
        if order.at_end is AtEnd.CONTACT:
            if x.mode is State.HOVERING:
                x = self.flight_state = self._thrust.adopted(x, self.law, self.compensator)
            self.law.check_contact(order.source)
        self._schedule.set_next(order)

    def keep_ready(self, order: Order) -> None:
        """Keep a recovery that leaves the trajectory with the same id, for an abort before that recovery's start. [P:V-B]

        Raises:
            TrajectoryRefused: the recovery is not continuous.
        """
        self._schedule.keep_ready(self.flight_state, order)

    def abort(self, reason: str = "abort was requested") -> str:
        """End the running manoeuvre in a hover, by a recovery where the vehicle is tilted. Return what is done.

        Raises:
            CommandRefused: the motors are off, so that there is nothing to end.
        """
        x = self.flight_state
        if x.mode in (State.DISARMED, State.FAILED):
            raise CommandRefused(f"abort is refused: {x.message}")
        if x.mode in (State.RECOVERING, State.LANDING):
            return f"already {x.mode.name.lower()}: {x.message}"
        if x.mode in (State.TRACKING, State.HOVERING):
            self.flight_state = self._end_maneuver(x, reason)
        elif x.mode in (State.ARMED, State.ATTACHED):
            self._schedule.clear()
            self.flight_state = x._replace(message=f"{reason}; no manoeuvre is running")
        return self.flight_state.message

    def _end_maneuver(self, x: FlightState, reason: str) -> FlightState:
        """End the running manoeuvre: by the next planned way out, or at once."""
        return self._schedule.leave_by_way_out(x, reason) or self._brake_to_hover(x, reason)

    def _brake_to_hover(self, x: FlightState, reason: str) -> FlightState:
        """Discard pending trajectories and brake to a hover, or land where a hover would touch the ground; a hover continues, with its brake.

        After the brake, it continues as one that has just begun: `silence_time` counts from the last order."""
        self._schedule.clear()
        if x.low:
            return landing(x, f"landing: {reason}", self.settings.land_speed)
        if x.mode is not State.HOVERING:
            return stopped(x, reason)
        if x.elapsed > x.source.duration:
            x = following(x, Hold(x.setpoint()))
        return x._replace(message=reason)

    def report_refusal(self, message: str) -> None:
        """Publish why an order was refused."""
        self.flight_state = self.flight_state._replace(message=message)

    # -- sensors -----------------------------------------------------------------------------------------------------

    def estimator(self, state: int, vio_age: float, message: str) -> None:
        """Act on the estimator's health: state as in `perch_msgs/EstimatorStatus`, age of the last VIO measurement [s]."""
        verdict = self._estimator_verdict = EstimatorVerdict.of(state, vio_age, message)
        if not verdict.position:
            self.descend(verdict.problem, moving=verdict.velocity)
        elif verdict.problem:
            self.flight_state = self._leave_or_brake(self.flight_state, verdict.problem)

    def _leave_or_brake(self, x: FlightState, reason: str) -> FlightState:
        """Leave a trajectory by a planned way out, or brake; continue where even the hardest brake would end in the surface."""
        if x.mode is not State.TRACKING:
            return x
        return self._schedule.leave_by_way_out(x, reason) or (x if committed(x) else self._brake_to_hover(x, f"hover: {reason}"))

    def descend(self, message: str, moving: bool = True) -> None:
        """Begin a descent without position; `moving`: whether the last velocity is trusted."""
        self.flight_state = self._descending(self.flight_state, message, moving)

    def _descending(self, x: FlightState, message: str, moving: bool = True) -> FlightState:
        if x.blind is not None or not x.flying:
            return x
        x = descending(x, message, self._thrust.observed_vehicle(x), self.gains, self._inputs.imu_since_odometry, moving)
        self._inputs.imu_since_odometry.clear()
        return x

    def imu(self, stamp: float, gyro: tuple[float, ...], accel: tuple[float, ...]) -> None:
        """Take an IMU sample; used in a descent without position, and kept for its beginning. Time [s], in B [rad/s, m/s^2].

        Its stamp also reveals that odometry with an older stamp is late.
        """
        self._thrust.measured_specific_thrust = accel[2]
        self.flight_state = self.supervisor.imu(self.flight_state, stamp, gyro, accel)
        if self.flight_state.blind is not None:
            self.flight_state.blind.imu(stamp, gyro, accel)
        self._inputs.imu(stamp, gyro, accel, keep=self.flight_state.blind is None)

    # -- one step ----------------------------------------------------------------------------------------------------

    def step(self, stamp: float, sample: tuple[float, ...], covariances: tuple[np.ndarray, np.ndarray] | None = None,
             problem: str = "") -> StepResult:
        """Answer one odometry sample with a command, also while disarmed or where the sample is refused.

        Args:
            stamp: stamp of the sample [s].
            sample: p_WB, v_WB (in W), q_WB (xyzw), w_WB_B, 13 floats.
            covariances: covariances of the sample, as in `OdometryGate.check`.
            problem: why the sample is invalid; empty: all its values are within their limits.
        """
        if self._period.update(stamp):
            self.law.set_period(self._period.value)
        x, verdict = self._inputs.odometry(self.flight_state, stamp, sample, covariances, problem)
        lost = self.odometry_age > self.settings.odometry_timeout
        if lost or verdict.jumped:
            self._schedule.clear()
        if x.blind is None and x.flying:
            if lost:
                x = self._descending(x, self._inputs.refusal or "no odometry")
            elif verdict.jumped:
                x = hover_after_jump(x, verdict.reason)
            elif x.mode is State.LANDING and x.elapsed > self.supervisor.longest_landing:
                x = self._descending(x, "the landing has taken too long")
        if x.blind is None:
            x = self._schedule.activated(x)
            if x.flying:
                if not x.airborne and not x.at_ground:
                    x = x._replace(airborne=True)
                imu_fresh = self._inputs.imu_age(x.now) <= self.settings.odometry_timeout
                x = self.supervisor.act(self._thrust.updated(x, self.law, self.compensator, imu_fresh), self._schedule.waiting)
        return self._finish_step(x)

    def step_blind(self, stamp: float) -> StepResult:
        """Answer a step without odometry, from the IMU alone; without IMU samples for `DOWN_TIME`, the motors are stopped."""
        self._schedule.clear()
        x = self._inputs.without_odometry(self.flight_state, stamp)
        if x.flying and self._inputs.imu_age(stamp) > DOWN_TIME:
            x = motors_off(x, State.FAILED, f"neither odometry nor IMU for {DOWN_TIME:g} s, motors off")
        return self._finish_step(self._descending(x, "no odometry"))

    def _finish_step(self, x: FlightState) -> StepResult:
        """Return the command that follows from the state, and store the state after it."""
        x, result = self._actuated(x)
        self.flight_state = x._replace(events=()) if x.events else x
        return result

    def _actuated(self, x: FlightState) -> tuple[FlightState, StepResult]:
        if x.blind is not None:
            if not x.blind.landed and x.blind.age <= self.supervisor.longest_landing:
                return actuation.descend(x, x.blind)
            if x.blind.landed:
                x = self._landed(x, "landed without position, motors off")
            else:
                longest = self.supervisor.longest_landing
                x = motors_off(x, State.FAILED, f"descent without position: no ground contact within {longest:.0f} s, motors off")
        elif x.flying:
            setpoint = self.supervisor.setpoint(x)
            x, result = actuation.fly(x, setpoint, self.law, self.compensator, self._period.value)
            if not self.supervisor.landed(x, setpoint):
                return x, result
            x = self._landed(x, "landed, motors off")
        return actuation.rest(idling(x, self._schedule.waiting))

    def _landed(self, x: FlightState, message: str) -> FlightState:
        """Stop the motors after a landing: FAILED where the vehicle lies tilted, else DISARMED."""
        return motors_off(x, State.FAILED if self.supervisor.tilted else State.DISARMED, message)


def _check_flying(x: FlightState, name: str) -> None:
    """Refuse a command that requires a flight on a reference."""
    if not x.flying:
        raise CommandRefused(f"{name} is refused: not flying ({x.mode.name.lower()})")
    if x.blind is not None:
        raise CommandRefused(f"{name} is refused: {x.message}")


COMMANDS: dict[Command, Callable[[FlightController, FlightState, str], FlightState]] = {
    Command.DISARM: FlightController._disarm,
    Command.ARM: FlightController._arm,
    Command.HOVER: FlightController._hover,
    Command.LAND: FlightController._land,
    Command.ATTACHED: FlightController._attach,
    Command.KILL: FlightController._kill,
}
"""Handler of each command: returns the next state from the present one and the reason."""
