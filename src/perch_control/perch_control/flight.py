"""The controller without ROS: states, references, control law and supervisor, one `step` per odometry sample."""

from __future__ import annotations

from math import inf
from typing import Any, Protocol

from perch_control.admission import AtEnd, Order, TrajectoryRefused, check_joints, check_start
from perch_control.descent import BlindDescent
from perch_control.flight_settings import FlightSettings
from perch_control.geometric import ControlOutput
from perch_control.geometric.controller import NO_COMPENSATION, packed_vehicle
from perch_control.geometric.step import predicted
from perch_control.guidance import Hold, blended, brake
from perch_control.modes import FLYING, Command, CommandRefused, State, StepResult
from perch_control.monitors import Persistent, TrackingMonitor, reference_tilt_deg
from perch_control.odometry_gate import OdometryGate
from perch_control.recovery import Recovery
from perch_control.reference import Setpoint
from perch_control.rotor_lag import RotorEstimate, thrusts
from perch_control.settings import GeometricGains
from perch_control.vector3 import axes_of, axpy, norm, scale
from perch_core.vehicle import GRAVITY, Vehicle

PERIOD = 0.002
_COASTING, _DIVERGED = 2, 3  # perch_msgs/EstimatorStatus
_NEAR_CONTACT = 0.35  # an abort so shortly before a contact pushes away from the surface first [s]


class Law(Protocol):
    """A control law: geometric or NMPC."""

    name: str

    def prepare(self, source, contact: bool):
        """The reference to follow for a trajectory, which ends in a contact or not."""

    def control(self, state: tuple[float, ...], preview, rotors: RotorEstimate, compensation: tuple[float, ...],
                time_to_contact: float) -> ControlOutput:
        """Rotor commands; `preview(dt)` is the setpoint `dt` seconds from now."""


class FlightController:
    """Owns the state machine, the running reference, the rotor estimate and the monitors."""

    def __init__(self, vehicle: Vehicle, law: Law, gains: GeometricGains, settings: FlightSettings) -> None:
        self.vehicle, self.law, self.settings = vehicle, law, settings
        self.state, self.message = State.DISARMED, "disarmed"
        self.gate = OdometryGate(settings.odometry)
        self.rotors = RotorEstimate.at_idle(vehicle)
        self.order: Order | None = None
        self.trajectory_id = 0
        self.now = 0.0
        self.odometry_age = inf
        self.margin = 1.0
        self.position_error = 0.0
        self.compensator = None
        self._constants = packed_vehicle(vehicle)
        self._pending: Order | None = None
        self._prepared: Any = None            # what is followed for `_pending`
        self._source = Hold(Setpoint((0.0, 0.0, 0.0)))
        self._start = 0.0                     # time at which `_source` began [s]
        self._events: list[str] = []
        self._belief: tuple[float, ...] = ()  # state flown on: odometry, or its prediction while it is refused
        self._blind: BlindDescent | None = None
        self._gains = gains
        self._refused = ""
        self._attached_to: tuple[float, ...] | None = None  # normal of the surface that carries the vehicle
        self._new_monitors()

    def _new_monitors(self) -> None:
        self._monitor = TrackingMonitor(self.settings, self.vehicle.body_rate_max)
        self._ground = Persistent(self.settings.ground_time)

    @property
    def law_name(self) -> str:
        """Name of the control law that flies, `+l1` with the augmentation."""
        return self.law.name + ("+l1" if self.compensator is not None else "")

    @property
    def trajectory_time(self) -> float:
        """Time since the start of the running trajectory [s], 0 without one."""
        return self.now - self._start if self.order is not None else 0.0

    def use(self, law: Law, gains: GeometricGains) -> None:
        """Fly another law, or the same one with other gains, from the next step on."""
        self.law, self._gains = law, gains

    # -- orders ------------------------------------------------------------------------------------------------------

    def command(self, command: Command, reason: str = "") -> None:
        """Carry out a command.

        Raises:
            CommandRefused: it is not possible in the present state.
        """
        why = f": {reason}" if reason else ""
        if command is Command.KILL:
            self._motors_off(State.FAILED, f"killed{why}")
        elif command is Command.ATTACHED:
            normal = self._surface_normal()
            self._motors_off(State.DISARMED, f"attached, motors off{why}")
            self._attached_to = normal or axes_of(self._belief[6:10])[2]
        elif command is Command.DISARM:
            if self.state in FLYING:
                raise CommandRefused(f"disarm is refused in flight ({self.state.name.lower()}); land first, or kill")
            self._motors_off(State.DISARMED, f"disarmed{why}")
        elif command is Command.ARM:
            self._arm()
        elif self.state is State.RECOVERING and command is Command.HOVER:
            pass  # a recovery ends in a hover, and must not be cut short
        elif self.state not in FLYING:
            raise CommandRefused(f"{command.name.lower()} is refused: not flying ({self.state.name.lower()})")
        elif command is Command.HOVER:
            self._stop(f"hover{why}")
        else:
            self._land(f"landing{why}")

    def follow(self, order: Order) -> None:
        """Take a trajectory; it starts at its stamp and replaces the running one there.

        Raises:
            TrajectoryRefused: it may not be flown.
        """
        if self.state not in (State.ARMED, State.TRACKING, State.HOVERING):
            raise TrajectoryRefused(f"the vehicle is {self.state.name.lower()}, not armed and ready")
        check_joints(order.source.trajectory, self.settings.joint_gap)
        check_start(order, self.now, self._expected(max(order.start, self.now)), self.settings)
        self._prepared = self.law.prepare(order.source, order.at_end is AtEnd.CONTACT)
        self._pending = order

    def estimator(self, state: int, vio_age: float, message: str) -> None:
        """Take the estimator's health: state as in `perch_msgs/EstimatorStatus`, age of the last VIO measurement [s]."""
        if self.state not in FLYING or self._blind is not None:
            return
        s = self.settings
        if state == _DIVERGED:
            self._descend_blind(f"the estimator has diverged: {message}")
        elif state == _COASTING and vio_age > s.coasting_land_time:
            self._descend_blind(f"no VIO for {vio_age:.1f} s")
        elif state == _COASTING and vio_age > s.coasting_time and self.state is State.TRACKING:
            self._stop(f"hover: no VIO for {vio_age:.1f} s")

    def abort(self, reason: str = "abort was requested") -> str:
        """End whatever is flown in a hover, through a recovery where the vehicle is tilted. Returns what is done."""
        if self.state in (State.TRACKING, State.HOVERING):
            self._stop(reason)
        return self.message

    def _expected(self, time: float) -> Setpoint:
        """Where the vehicle will be: the reference in flight, the state on the ground."""
        if self.state in (State.TRACKING, State.HOVERING):
            return self._source.setpoint(time - self._start)
        return Setpoint(self._belief[0:3], self._belief[3:6])

    def _arm(self) -> None:
        if self.state is State.ARMED or self.state in FLYING:
            return
        if self.state is not State.DISARMED:
            raise CommandRefused(f"arm is refused: {self.state.name.lower()}")
        if self.odometry_age > self.settings.odometry.timeout:
            raise CommandRefused("arm is refused: no usable odometry" + (f" ({self._refused})" if self._refused else ""))
        if self._attached_to is not None:
            normal, self._attached_to = self._attached_to, None
            self.rotors = RotorEstimate((0.0,) * 4, (0.0,) * 4)
            self._recover("came off the surface", normal)
            return
        _, _, b3 = axes_of(self._belief[6:10])
        if b3[2] < 0.7:
            raise CommandRefused("arm is refused: the vehicle is tilted by more than 45 deg")
        self._enter(State.ARMED, "armed")
        self.rotors = RotorEstimate.at_idle(self.vehicle)

    # -- transitions -------------------------------------------------------------------------------------------------

    def _enter(self, state: State, message: str) -> None:
        self.state, self.message = state, message
        self._events.append(message)
        self._new_monitors()
        if state is not State.TRACKING:
            self.order = None
        if state not in (State.ARMED, State.TRACKING, State.HOVERING):
            self._pending = None

    def _motors_off(self, state: State, message: str) -> None:
        self._enter(state, message)
        self._blind, self.trajectory_id = None, 0
        self.rotors = RotorEstimate((0.0,) * 4, (0.0,) * 4)

    def _run(self, source) -> None:
        self._source, self._start = source, self.now

    def _stop(self, message: str) -> None:
        """Brake to a hover; out of a tilted attitude by way of a recovery."""
        setpoint = self._source.setpoint(self.now - self._start)
        _, _, b3 = axes_of(self._belief[6:10])
        if b3[2] < 0.7 or reference_tilt_deg(self._belief, setpoint) > self.settings.tilt_margin_deg:
            self._recover(message)
            return
        near = norm(axpy(-1.0, setpoint.p, self._belief[0:3])) < 0.3 and self.state in (State.TRACKING, State.HOVERING)
        p, v, a = (setpoint.p, setpoint.v, setpoint.a) if near else (self._belief[0:3], self._belief[3:6], (0.0,) * 3)
        self._enter(State.HOVERING, message)
        self._run(brake(p, v, a, setpoint.h, deceleration=self.settings.brake_deceleration))

    def _surface_normal(self) -> tuple[float, ...] | None:
        """Outward normal of the surface that the running trajectory is about to touch or has touched, None: in the open."""
        order = self.order
        if order is None or order.at_end is not AtEnd.CONTACT or self.now - self._start < order.source.duration - _NEAR_CONTACT:
            return None
        a = order.source.setpoint(order.source.duration).a
        f = (a[0], a[1], a[2] + GRAVITY)
        return scale(1.0 / max(norm(f), 1e-6), f)

    def _recover(self, message: str, normal: tuple[float, ...] | None = None) -> None:
        normal = normal or self._surface_normal()
        thrust_max = 4.0 * self.vehicle.thrust_max / self.vehicle.mass
        self._enter(State.RECOVERING, f"recovering: {message}")
        self._run(Recovery(self.settings.recovery, thrust_max, self._belief, normal))

    def _land(self, message: str) -> None:
        x = self._source.setpoint(self.now - self._start)
        follows = self.state in (State.TRACKING, State.HOVERING)
        p, v, a = (x.p, x.v, x.a) if follows else (self._belief[0:3], self._belief[3:6], (0.0,) * 3)
        self._enter(State.LANDING, message)
        self._run(brake(p, v, a, x.h, (0.0, 0.0, -self.settings.land_speed), self.settings.brake_deceleration))

    def _descend_blind(self, message: str) -> None:
        if self._blind is not None or self.state not in FLYING:
            return
        self._enter(State.LANDING, f"descent without position: {message}")
        self._blind = BlindDescent(self.vehicle, self._gains, self.settings, self._belief[6:10], self._belief[10:13], self.now)

    def imu(self, stamp: float, gyro: tuple[float, ...], accel: tuple[float, ...]) -> None:
        """Take an IMU sample; used in a descent without position alone. Time [s], in B [rad/s, m/s^2]."""
        if self._blind is not None:
            self._blind.imu(stamp, gyro, accel)

    def step_blind(self, stamp: float) -> StepResult:
        """Answer a step for which no odometry has come, from the IMU alone."""
        dt = min(max(stamp - self.now, 0.0), 0.1)
        self.now, self.odometry_age = stamp, self.odometry_age + dt
        self.rotors = self.rotors.after(dt, self.vehicle.motor_time_constant)
        self._descend_blind("no odometry")
        return self._descend() if self._blind is not None else self._idle()

    def _descend(self) -> StepResult:
        if self._blind.landed:
            self._motors_off(State.DISARMED, "landed without position, motors off")
            return self._idle()
        speed, thrust = self._blind.rotors(self.rotors.speed)
        self.rotors = self.rotors.following(speed)
        self.margin = (self.vehicle.thrust_max - max(thrust)) / self.vehicle.thrust_max
        return StepResult(True, speed, wrench=self._blind.wanted(), margin=self.margin, event=self._event())

    # -- one step ----------------------------------------------------------------------------------------------------

    def step(self, stamp: float, sample: tuple[float, ...]) -> StepResult:
        """Answer one odometry sample: always with a command, also when disarmed or when the sample is refused.

        Args:
            stamp: of the sample [s].
            sample: p_WB, v_WB (in W), q_WB (xyzw), w_WB_B, 13 floats.
        """
        dt = min(max(stamp - self.now, 0.0), 0.1)
        self.now = stamp
        self.rotors = self.rotors.after(dt, self.vehicle.motor_time_constant)
        verdict = self.gate.check(stamp, sample)
        if verdict.usable:
            self._belief, self._refused = sample, ""
        else:
            if verdict.reason and not self._refused:
                self._events.append(f"refused: {verdict.reason}")
            self._refused = verdict.reason
            if self._belief and self.state in FLYING:
                f = thrusts(self.rotors.speed, self.vehicle.thrust_coefficient)
                self._belief = predicted(self._belief, f, NO_COMPENSATION, dt, self._constants[0][0],
                                         self._constants[0][1:4], self._constants[2])
        self.odometry_age = stamp - self.gate.stamp if self.gate.stamp is not None else inf
        if self.state in FLYING:
            if self.odometry_age > self.settings.odometry.timeout:
                self._descend_blind(self._refused or "no odometry")
            elif verdict.jumped and self._blind is None:
                self._jumped(verdict.reason)
        if self._blind is not None:
            return self._descend()
        self._activate()
        if self.state in FLYING:
            self._supervise()
        if self.state in FLYING:
            return self._fly()
        return self._idle()

    def _jumped(self, reason: str) -> None:
        """The estimate has moved: what was planned no longer fits; stay where the vehicle now believes to be."""
        self._source, self._start = Hold.at(self._belief[0:3], axes_of(self._belief[6:10])[1]), self.now
        self._stop(reason)

    def _idle(self) -> StepResult:
        armed = self.state is State.ARMED
        speed = (self.vehicle.speed_min,) * 4 if armed else (0.0,) * 4
        self.rotors = self.rotors.following(speed)
        self.margin, self.position_error = 1.0, 0.0
        return StepResult(armed, speed, event=self._event())

    def _event(self) -> str:
        text = "; ".join(self._events)
        self._events.clear()
        return text

    def _activate(self) -> None:
        """Start the pending trajectory when its time has come."""
        order = self._pending
        if order is None or self.now < order.start:
            return
        self._pending = None
        late = self.now - order.start
        # On the ground there is nothing to continue; in the air the new reference is reached without a jump.
        present = self._expected(self.now)
        source = self._prepared if self.state is State.ARMED else blended(present, self._prepared, late)
        self._enter(State.TRACKING, f"tracking trajectory {order.id}")
        self.order, self._source, self._start, self.trajectory_id = order, source, order.start, order.id

    def _supervise(self) -> None:
        t = self.now - self._start
        s = self.settings
        if isinstance(self._source, Recovery):
            self._source.update(self._belief, t)
            if self._source.finished:
                self._enter(State.HOVERING, "recovered: hovering")
                self._run(brake(self._belief[0:3], self._belief[3:6], (0.0,) * 3, axes_of(self._belief[6:10])[1]))
            elif t > s.recovery.timeout:
                self._land("landing: the recovery did not come to rest")
            return
        setpoint = self._source.setpoint(t)
        deviation = self._monitor.deviation(self._belief, setpoint, self.now)
        outside = self._monitor.outside(self._belief[0:3])
        if deviation and self.state is not State.LANDING:
            self._recover(deviation)
        elif outside > s.fence_slack and self.state is not State.LANDING:
            self._land(f"landing: {outside:.1f} m outside the geofence")
        elif outside > 0.0 and self.state is State.TRACKING:
            self._stop(f"hover: {outside:.1f} m outside the geofence")
        elif self.state is not State.LANDING and self._monitor.exhausted(self.margin, self.now):
            self._land("landing: the rotors are at their limit")
        elif self.state is State.TRACKING:
            self._at_end(t)
        elif self.state is State.HOVERING and t > s.silence_time:
            self._land(f"landing: no order for {s.silence_time:.0f} s")

    def _at_end(self, t: float) -> None:
        order = self.order
        over = t - order.source.duration
        if order.at_end is AtEnd.CONTACT:
            if over > order.contact_time:
                self._recover("contact was missed")
        elif over >= 0.0:
            if order.at_end is AtEnd.LAND:
                self._land(f"landing after trajectory {order.id}")
            else:
                self._stop(f"hovering at the end of trajectory {order.id}")

    def _fly(self) -> StepResult:
        t = self.now - self._start
        setpoint = self._source.setpoint(t)
        self.position_error = norm(axpy(-1.0, setpoint.p, self._belief[0:3]))
        contact = inf
        if self.state is State.TRACKING and self.order.at_end is AtEnd.CONTACT:
            contact = max(self.order.source.duration - t, 0.0)
        extra = NO_COMPENSATION
        if self.compensator is not None:
            extra = self.compensator.update(self._belief, self.rotors, self.state is not State.LANDING)
        out = self.law.control(self._belief, lambda ahead: self._source.setpoint(t + ahead), self.rotors, extra, contact)
        self.rotors = self.rotors.following(out.rotor_speed)
        top = self.vehicle.thrust_max
        self.margin = (top - max(out.rotor_thrust)) / top
        if self.state is State.LANDING and self._on_ground(setpoint):
            self._motors_off(State.DISARMED, "landed, motors off")
            return self._idle()
        return StepResult(True, out.rotor_speed, setpoint, out.q_C, out.w_C, out.dw_C, out.wrench, self.margin, self._event())

    def _on_ground(self, setpoint: Setpoint) -> bool:
        resting = abs(self._belief[5]) < 0.1 and self._belief[2] - setpoint.p[2] > self.settings.ground_gap
        return self._ground.update(resting, self.now)
