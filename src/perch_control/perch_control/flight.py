"""The controller without ROS: orders in, one `step` per odometry sample out, and the supervisor between them."""

from __future__ import annotations

from math import dist, inf

import numpy as np

from perch_core.vector3 import axes_of
from perch_core.vehicle import ControlGains, Vehicle
from perch_control.admission import AtEnd, Order, TrajectoryRefused, check_joints, check_start
from perch_control.descent import BlindDescent
from perch_control.flight_settings import FlightSettings
from perch_control.geometric import packed_vehicle
from perch_control.geometric.step import predicted
from perch_control.guidance import Running
from perch_control.inner_loop import Later
from perch_control.l1 import L1Augmentation
from perch_control.law import NO_COMPENSATION, Law
from perch_control.maneuvers import Maneuvers
from perch_control.modes import Command, CommandRefused, State, StepResult
from perch_control.monitors import DOWN_TIME
from perch_control.odometry_gate import OdometryGate, Verdict
from perch_control.period import NOMINAL_PERIOD, MeasuredPeriod
from perch_control.rotor_health import RotorHealth
from perch_control.rotor_lag import thrusts
from perch_control.schedule import Schedule
from perch_control.smooth_position import SmoothPosition
from perch_control.supervisor import Supervisor
from perch_control.thrust_belief import AIRBORNE, ThrustBelief

_SPARE_SHARE = 0.01          # weight of a step of 2 ms in the mean margin: 0.2 s
_NOWHERE = (0.0,) * 6        # position and velocity of a descent that knows neither
_STILL = (0.0,) * 9 + (1.0, 0.0, 0.0, 0.0)
_MARGIN_PERCH = 0.15         # a perch is refused where the mean thrust margin in hover is less: one rotor is far weaker
_IDLE_TIME = 10.0            # armed on the ground without a trajectory for so long: motors off [s]
_ARM_TILT = 0.7              # cosine of the largest tilt at which the motors are started on the ground


class FlightController:
    """Takes orders, judges odometry, supervises, and asks the control law for rotor commands."""

    def __init__(self, vehicle: Vehicle, law: Law, gains: ControlGains, settings: FlightSettings) -> None:
        self.law = law
        self.maneuvers = Maneuvers(vehicle, gains, settings)
        self._schedule = Schedule(self.maneuvers)
        self.supervisor = Supervisor(self.maneuvers, self._leave)
        self.gate = OdometryGate()
        self.odometry_age = inf
        self.margin = 1.0
        self._spare = 1.0            # mean margin in hover
        self.position_error = 0.0
        self.compensator: L1Augmentation | None = None
        self._thrust = ThrustBelief(vehicle, self.maneuvers)
        self._imu_stamp = -inf
        self._refused = ""
        self._smooth = SmoothPosition()
        self._period = MeasuredPeriod()

    @property
    def settings(self) -> FlightSettings:
        """Limits and speeds; may be replaced in flight."""
        return self.maneuvers.settings

    def use(self, law: Law, gains: ControlGains, settings: FlightSettings) -> None:
        """Fly another law, or the same one with other gains and limits, from the next step on."""
        if law is not self.law:
            law.begin()
        self.law, self.maneuvers.gains, self.maneuvers.settings = law, gains, settings
        law.believe(self.vehicle)
        law.pace(self._period.value)
        self.supervisor.restart()

    @property
    def state(self) -> State:
        """As published."""
        return self.maneuvers.state

    @property
    def vehicle(self) -> Vehicle:
        """As it is believed to be."""
        return self._thrust.vehicle

    @property
    def health(self) -> RotorHealth:
        """Of the rotors."""
        return self._thrust.health

    @property
    def blind(self) -> bool:
        """A descent without position is under way."""
        return self.maneuvers.blind is not None

    @property
    def law_name(self) -> str:
        """Name of the control law that flies, `+l1` with the augmentation."""
        return self.law.name + ("+l1" if self.compensator is not None else "")

    @property
    def trajectory_time(self) -> float:
        """Time since the start of the running trajectory [s], 0 without one."""
        return self.maneuvers.elapsed if self.maneuvers.order is not None else 0.0

    # -- orders ------------------------------------------------------------------------------------------------------

    def command(self, command: Command, reason: str = "") -> None:
        """Carry out a command.

        Raises:
            CommandRefused: it is not possible in the present state.
        """
        m, why = self.maneuvers, f": {reason}" if reason else ""
        if command is Command.KILL:
            m.motors_off(State.FAILED, f"killed{why}")
        elif command is Command.ATTACHED:
            if not m.belief:
                raise CommandRefused("attached is refused: no usable odometry yet")
            m.attach(f"attached, motors off{why}")
        elif command is Command.DISARM:
            if m.flying:
                raise CommandRefused(f"disarm is refused in flight ({m.state.name.lower()}); land first, or kill")
            m.motors_off(State.DISARMED, f"disarmed{why}")
        elif command is Command.ARM:
            self._arm()
        elif not m.flying:
            raise CommandRefused(f"{command.name.lower()} is refused: not flying ({m.state.name.lower()})")
        elif m.blind is not None:
            raise CommandRefused(f"{command.name.lower()} is refused: {m.message}")
        elif command is Command.LAND:
            m.land(f"landing{why}")
        elif m.state is not State.RECOVERING and not self._schedule.leave(f"hover{why}", self.law):  # a recovery ends in a hover, and must not be cut short
            m.stop(f"hover{why}")

    def _arm(self) -> None:
        m = self.maneuvers
        if m.state is State.ARMED or m.flying:
            return
        if m.state not in (State.DISARMED, State.ATTACHED):
            raise CommandRefused(f"arm is refused: {m.state.name.lower()}; disarm first")
        if self.odometry_age > self.settings.odometry_timeout:
            raise CommandRefused("arm is refused: no usable odometry" + (f" ({self._refused})" if self._refused else ""))
        self._thrust.reset(self.law, self.compensator)
        if m.state is State.ATTACHED:
            m.recover("leaving what carries the vehicle")
            return
        if axes_of(m.belief[6:10])[2][2] < _ARM_TILT:
            raise CommandRefused("arm is refused: the vehicle is tilted by more than 45 deg")
        m.enter(State.ARMED, "armed")
        m.start = m.now
        m.rotors = m.rotors.turning(self.vehicle.speed_min)
        m.ground = m.belief[2]

    def follow(self, order: Order) -> None:
        """Take a trajectory; it starts at its stamp and replaces the running one there.

        Raises:
            TrajectoryRefused: it may not be flown.
        """
        m = self.maneuvers
        if m.state is State.ATTACHED:
            self._thrust.reset(self.law, self.compensator)
        elif m.state not in (State.ARMED, State.TRACKING, State.HOVERING):
            raise TrajectoryRefused(f"the vehicle is {m.state.name.lower()}, not armed and ready")
        if m.state is State.HOVERING and order.at_end is not AtEnd.HOLD and self._spare < _MARGIN_PERCH:
            raise TrajectoryRefused(f"the thrust margin in hover is {self._spare:.2f}; a perch needs {_MARGIN_PERCH:g}")
        check_joints(order.source.trajectory)
        check_start(order, m.now, m.expected(max(order.start, m.now)))
        if order.at_end is AtEnd.CONTACT and m.state is State.HOVERING and self.compensator is not None:
            self._thrust.adopt(self.law, self.compensator)
        running = Running(m.source, order.start - m.start) if m.state is State.TRACKING and order.start >= m.now else None
        self._schedule.put(order, self.law.prepare(order.source, order.at_end is AtEnd.CONTACT, running))

    def keep_ready(self, order: Order) -> None:
        """Keep a recovery that leaves the trajectory with the same id, for an abort before it starts. [P:V-B]

        Raises:
            TrajectoryRefused: it may not be flown.
        """
        self._schedule.keep_ready(order)

    def abort(self, reason: str = "abort was requested") -> str:
        """End whatever is flown in a hover, through a recovery where the vehicle is tilted. Returns what is done."""
        if self.state in (State.TRACKING, State.HOVERING) and not self._schedule.leave(reason, self.law):
            self._schedule.drop()
            self.maneuvers.stop(reason)
        return self.maneuvers.message

    def _leave(self, reason: str) -> bool:
        return self._schedule.leave(reason, self.law)

    def imu(self, stamp: float, gyro: tuple[float, ...], accel: tuple[float, ...]) -> None:
        """Take an IMU sample; used in a descent without position, and kept for its beginning. Time [s], in B [rad/s, m/s^2].

        Its time also shows that odometry with an old stamp is late.
        """
        self._imu_stamp, self._thrust.felt = stamp, accel[2]
        self.supervisor.imu(stamp, gyro, accel)
        if self.maneuvers.blind is not None:
            self.maneuvers.blind.imu(stamp, gyro, accel)
        else:
            self.maneuvers.unseen.append((stamp, gyro, accel))

    # -- one step ----------------------------------------------------------------------------------------------------

    def step(self, stamp: float, sample: tuple[float, ...], covariances: tuple[np.ndarray, np.ndarray] | None = None) -> StepResult:
        """Answer one odometry sample: always with a command, also when disarmed or when the sample is refused.

        Args:
            stamp: of the sample [s].
            sample: p_WB, v_WB (in W), q_WB (xyzw), w_WB_B, 13 floats.
            covariances: its own, as `OdometryGate.check` takes them.
        """
        m = self.maneuvers
        if self._period.update(stamp):
            self.law.pace(self._period.value)
        # Odometry that repeats itself does not stop the time.
        dt = self._advance(stamp if stamp > m.now else max(m.now, self._imu_stamp))
        verdict = self.gate.check(stamp, sample, covariances)
        self._believe(verdict, sample, dt)
        self.odometry_age = m.now - self.gate.stamp if self.gate.stamp is not None else inf
        if m.flying and m.blind is None:
            if self.odometry_age > self.settings.odometry_timeout:
                m.descend(self._refused or "no odometry")
            elif verdict.jumped:
                m.stay(verdict.reason)
        if m.blind is not None:
            return self._descend(m.blind)
        self._schedule.activate(self.law)
        if m.flying:
            self._thrust.judge(self.law, self.compensator)
            self.supervisor.act(self.margin)
        return self._fly() if m.flying else self._idle()

    def step_blind(self, stamp: float) -> StepResult:
        """Answer a step for which no odometry has come, from the IMU alone; without that nobody knows where up is for long."""
        m = self.maneuvers
        self.odometry_age += self._advance(stamp)
        if m.flying and stamp - self._imu_stamp > DOWN_TIME:
            m.motors_off(State.FAILED, f"neither odometry nor IMU for {DOWN_TIME:g} s")
        m.descend("no odometry")
        return self._descend(m.blind) if m.blind is not None else self._idle()

    def _advance(self, stamp: float) -> float:
        m = self.maneuvers
        dt = min(max(stamp - m.now, 0.0), 0.1)
        m.now = stamp
        m.rotors = m.rotors.after(dt, self.vehicle.motor_time_constant)
        return dt

    def _believe(self, verdict: Verdict, sample: tuple[float, ...], dt: float) -> None:
        m = self.maneuvers
        if verdict.usable:
            m.belief, self._refused = self._smooth.of(m.now, sample, m.order), ""
            m.seen = m.now, sample
            m.unseen.clear()
            return
        if verdict.reason and not self._refused:
            m.events.append(f"refused: {verdict.reason}")
        self._refused = verdict.reason
        if m.belief and m.flying:
            body, _, forward, *_ = packed_vehicle(self.vehicle)
            f = thrusts(m.rotors.speed, self.vehicle.thrust_coefficient)
            m.belief = predicted(m.belief, f, NO_COMPENSATION, dt, body[0], body[1:4], forward)

    def _fly(self) -> StepResult:
        m = self.maneuvers
        setpoint = m.setpoint()
        self.position_error = dist(setpoint.p, m.belief[0:3])
        contact = m.time_to_contact
        state, delay = m.rotors.ahead(m.belief, self.vehicle), m.rotors.delay
        reference = Later(m, delay) if delay > 0.0 else m
        out = self.law.control(state, reference, m.rotors.led, self._compensation(contact), max(contact - delay, 0.0))
        m.rotors = m.rotors.following(out.rotor_speed, state, self.vehicle, out.w_C)
        top = self.vehicle.thrust_max
        self.margin = (top - max(out.rotor_thrust)) / top
        if m.state is State.HOVERING:
            self._spare += _SPARE_SHARE * (self._period.value / NOMINAL_PERIOD) * (self.margin - self._spare)
        if self.supervisor.landed(setpoint):
            m.motors_off(self._lying, "landed, motors off")
            return self._idle()
        return StepResult(True, out.rotor_speed, setpoint, out.q_C, out.w_C, out.dw_C, out.wrench, self.margin, self._event(),
                          m.rotors.sent)

    def _compensation(self, contact: float) -> tuple[float, ...]:
        """What makes up for disturbances; only air may be taken for one, so not what the ground or a wall does."""
        m = self.maneuvers
        if self.compensator is None:
            return NO_COMPENSATION
        if m.belief[2] - m.ground < AIRBORNE:
            self.compensator.reset()
            return NO_COMPENSATION
        if m.state in (State.LANDING, State.RECOVERING) or contact <= 0.0 or m.may_touch(0.0):
            return self.compensator.hold()
        return self.compensator.update(m.belief, m.rotors.speed, m.now)

    def _descend(self, blind: BlindDescent) -> StepResult:
        m = self.maneuvers
        if blind.landed:
            m.motors_off(self._lying, "landed without position, motors off")
            return self._idle()
        speed, thrust = blind.rotors(m.rotors.led.speed)
        m.rotors = m.rotors.following(speed, (*_NOWHERE, *blind.attitude.q, *blind.attitude.w), self.vehicle)
        self.margin = (self.vehicle.thrust_max - max(thrust)) / self.vehicle.thrust_max
        return StepResult(True, speed, wrench=blind.wanted(), margin=self.margin, event=self._event(), loop=m.rotors.sent)

    @property
    def _lying(self) -> State:
        """What the state is on the ground, as the vehicle lies there."""
        return State.FAILED if self.supervisor.tilted else State.DISARMED

    def _idle(self) -> StepResult:
        m = self.maneuvers
        if m.state is State.ARMED and not self._schedule.waiting and m.elapsed > _IDLE_TIME:
            m.motors_off(State.DISARMED, f"disarmed: no trajectory for {_IDLE_TIME:g} s")
        armed = m.state is State.ARMED
        speed = (self.vehicle.speed_min,) * 4 if armed else (0.0,) * 4
        m.rotors = m.rotors.following(speed, m.belief or _STILL, self.vehicle)
        self.margin, self.position_error = 1.0, 0.0
        return StepResult(armed, speed, event=self._event(), loop=m.rotors.sent)

    def _event(self) -> str:
        events = self.maneuvers.events
        if not events:
            return ""
        text = "; ".join(events)
        events.clear()
        return text
