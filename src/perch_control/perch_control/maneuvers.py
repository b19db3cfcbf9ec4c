"""The state of a flight and the changes between its states: stop, recover, land, descend, motors off."""

from __future__ import annotations

from collections import deque
from math import dist, inf
from typing import Any

from perch_core.vector3 import axes_of, axpy, dot, norm, scale
from perch_core.vehicle import GRAVITY, ControlGains, Vehicle
from perch_control.admission import AtEnd, Order
from perch_control.descent import BlindDescent
from perch_control.flight_settings import FlightSettings
from perch_control.guidance import BRAKE_PEAK, Hold, brake
from perch_control.inner_loop import stopped
from perch_control.modes import FLYING, State
from perch_control.monitors import TILT_MARGIN, reference_tilt_deg
from perch_control.recovery import Recovery
from perch_control.reference import Setpoint, peak_thrust
from perch_control.rotor_health import HOVER_LEAST, RESERVE
from perch_control.weak_landing import WeakLanding

_BRAKE = 4.0          # deceleration of a brake: leans by 22 deg at most [m/s^2]
_BRAKE_HARD = 8.0     # the same, at most, where the trajectory leads to a surface [m/s^2]
_NEAR_CONTACT = 0.35  # an abort so shortly before a contact pushes away from the surface first [s]
_FOLLOWED = 0.3       # nearer to the reference than this, a manoeuvre continues the reference, not the state [m]
_LEVEL = 0.8          # cosine of the tilt up to which a brake starts from the attitude as it is
_TURNING = 4.0        # the same for the body rate [rad/s]
_AWAY = 2.0           # radii of the body from the place of a contact at which nothing there holds the vehicle
_UPRIGHT = 0.7        # cosine of the tilt beyond which a recovery or a perch goes on before a landing on weak rotors begins
_ZERO = (0.0, 0.0, 0.0)


class Maneuvers:
    """Owns state, running reference, belief and rotor estimate of a flight.

    Attributes:
        state, message: as published; `flying`: the motors carry the vehicle.
        now: time of the step [s].
        belief: state that is flown on, 13 floats: odometry, or its prediction while odometry is refused.
        seen: stamp [s] and state of the last odometry sample that was accepted.
        unseen: IMU samples since then: time [s], rates [rad/s], specific force [m/s^2].
        rotors: rotor speeds, or the inner loop, as the lag model has them.
        source, start: running reference and the time at which it began [s].
        order, trajectory_id: trajectory that is being tracked, or a planned way out of it while RECOVERING, else None; the id stays until
            another one or the motors' stop.
        attached_to: normal of the surface that carries the vehicle, None: none does.
        blind: the descent without position that is under way.
        events: what has happened since the last step.
        vehicle: as it is believed to be; `weak`: its rotors give less than its file says.
        ground: height at which the vehicle was armed [m].
    """

    def __init__(self, vehicle: Vehicle, gains: ControlGains, settings: FlightSettings) -> None:
        self.vehicle, self.gains, self.settings = vehicle, gains, settings
        self.state, self.message, self.flying = State.DISARMED, "disarmed", False
        self.now = 0.0
        self.belief: tuple[float, ...] = ()
        self.seen: tuple[float, tuple[float, ...]] = (0.0, ())
        self.unseen: deque[tuple[float, tuple[float, ...], tuple[float, ...]]] = deque(maxlen=250)
        self.rotors = stopped(vehicle)
        self.source: Any = Hold(Setpoint(_ZERO))
        self.start = 0.0
        self._asked: tuple[Any, float, Setpoint] = (None, 0.0, Setpoint(_ZERO))
        self.order: Order | None = None
        self.trajectory_id = 0
        self.attached_to: tuple[float, ...] | None = None
        self.blind: BlindDescent | None = None
        self.events: list[str] = []
        self.weak, self.ground = False, -inf
        self._meeting: tuple[float, tuple[float, ...]] | None = None  # when and where a surface or a wire is met [s, m]
        self._judged: tuple[Any, Vehicle, bool] | None = None  # whether this reference is too much for this vehicle

    @property
    def elapsed(self) -> float:
        """Time since the running reference began [s]."""
        return self.now - self.start

    def setpoint(self, ahead: float = 0.0) -> Setpoint:
        """The running reference `ahead` seconds from now; supervisor and step ask for the same one, which is worked out once."""
        source, t = self.source, self.elapsed + ahead
        if self._asked[0] is not source or self._asked[1] != t or getattr(source, "by_state", False):
            self._asked = source, t, source.setpoint(t)
        return self._asked[2]

    def expected(self, time: float) -> Setpoint:
        """Where the vehicle will be at a time [s]: on its reference in flight, where it is on the ground."""
        if self.state in (State.TRACKING, State.HOVERING):
            return self.source.setpoint(time - self.start)
        return Setpoint(self.belief[0:3], self.belief[3:6])

    def enter(self, state: State, message: str) -> None:
        """Change the state, and say why."""
        self.state, self.message, self.flying = state, message, state in FLYING
        self.events.append(message)
        if state is not State.TRACKING:
            self.order = None
        if state not in (State.TRACKING, State.RECOVERING):
            self._meeting = None

    def run(self, source: Any) -> None:
        """Follow a reference from now on."""
        self.source, self.start = source, self.now

    def track(self, order: Order, source: Any, leaving: str = "") -> None:
        """Follow a trajectory, by the reference made from it; `leaving`: why it is flown, a planned way out."""
        if leaving:
            self.enter(State.RECOVERING, f"recovering as planned: {leaving}")
        else:
            self.enter(State.TRACKING, f"tracking trajectory {order.id}")
        self.attached_to = None
        self.order, self.source, self.start, self.trajectory_id = order, source, order.start, order.id
        met = {AtEnd.CONTACT: order.source.duration, AtEnd.RECOVER: order.recovery_start}.get(order.at_end, -1.0)
        if met >= 0.0:  # a way out that begins there meets nothing else
            self._meeting = order.start + met, order.source.setpoint(met).p

    def motors_off(self, state: State, message: str) -> None:
        """Stop the motors."""
        self.enter(state, message)
        self.blind, self.trajectory_id = None, 0
        self.rotors = self.rotors.turning(0.0)

    def attach(self, message: str) -> None:
        """Stop the motors on a surface that carries the vehicle."""
        normal = self._surface_normal() or axes_of(self.belief[6:10])[2]
        self.motors_off(State.ATTACHED, message)
        self.attached_to = normal

    def stop(self, message: str) -> None:
        """Brake to a hover; out of a tilted attitude by way of a recovery."""
        setpoint = self.setpoint()
        _, _, b3 = axes_of(self.belief[6:10])
        turning = b3[2] < _LEVEL or norm(self.belief[10:13]) > _TURNING
        if turning or self._surface_normal() or reference_tilt_deg(self.belief, setpoint) > TILT_MARGIN:
            self.recover(message)
            return
        p, v, a = self._point_of_departure(setpoint)
        deceleration = max(_BRAKE, min(self._needed_deceleration(), _BRAKE_HARD))
        self.enter(State.HOVERING, message)
        self.run(brake(p, v, a, setpoint.h, deceleration=deceleration))

    def stay(self, message: str) -> None:
        """Hover where the vehicle now believes to be: what was followed no longer fits."""
        self.run(Hold.at(self.belief[0:3], axes_of(self.belief[6:10])[1]))
        self.stop(message)

    def settle(self, message: str) -> None:
        """Hover after a recovery, from the state as it is."""
        self.enter(State.HOVERING, message)
        self.run(brake(self.belief[0:3], self.belief[3:6], _ZERO, axes_of(self.belief[6:10])[1]))

    def recover(self, message: str) -> None:
        """Return to a hover from any attitude; from a surface, push off first."""
        normal = self._surface_normal() or self.attached_to
        self.attached_to = None
        self.enter(State.RECOVERING, f"recovering: {message}")
        self.run(Recovery(self.specific_thrust_max, self.belief, normal))

    def land(self, message: str) -> None:
        """Descend until the ground is felt."""
        setpoint = self.setpoint()
        p, v, a = self._point_of_departure(setpoint)
        self.enter(State.LANDING, message)
        down = (0.0, 0.0, -self.settings.land_speed)
        self.run(brake(p, v, a, setpoint.h, down, _BRAKE))

    def land_weak(self, message: str) -> None:
        """Land at once, with what thrust there is."""
        self.enter(State.LANDING, f"landing on weak rotors: {message}")
        self.run(WeakLanding(self.settings.land_speed, self.belief, self.ground))
        self.source.update(self.belief, self.specific_thrust_max)

    @property
    def specific_thrust_max(self) -> float:
        """Greatest collective thrust / mass, as believed [m/s^2]."""
        return 4.0 * self.vehicle.thrust_max / self.vehicle.mass

    def beyond_what_is_left(self) -> str:
        """Why weak rotors cannot go on with what is flown; empty: they can."""
        left = self.specific_thrust_max
        said = f"at most {100.0 * left / GRAVITY:.0f} % of the weight is left"
        upright = axes_of(self.belief[6:10])[2][2] >= _UPRIGHT
        if self.order is not None:
            if upright and self.order.at_end is AtEnd.CONTACT:
                return f"{said}, too little to recover from a missed contact"
            if self._judged is None or self._judged[0] is not self.source or self._judged[1] is not self.vehicle:
                self._judged = self.source, self.vehicle, peak_thrust(self.source, self.elapsed) > RESERVE * left
            return f"{said}, less than the trajectory needs" if self._judged[2] else ""
        if self.state is State.RECOVERING and not upright:
            return ""
        return said if left < HOVER_LEAST * GRAVITY else ""

    def descend(self, message: str, moving: bool = True) -> None:
        """Descend without position: level, with a little less thrust than the weight; `moving`: the velocity can be trusted."""
        if self.blind is not None or not self.flying:
            return
        self.enter(State.LANDING, f"descent without position: {message}")
        # From the last sample that was accepted: the prediction since then knows less than the IMU.
        stamp, sure = self.seen
        self.blind = BlindDescent(self.vehicle, self.gains, sure[6:10], sure[10:13], stamp, sure[3:6] if moving else _ZERO)
        for sample in self.unseen:
            self.blind.imu(*sample)
        self.unseen.clear()

    def _point_of_departure(self, setpoint: Setpoint) -> tuple:
        """Position, velocity and acceleration from which a manoeuvre goes on: without a jump of the reference where the
        vehicle follows it, from the state where it does not."""
        near = dist(setpoint.p, self.belief[0:3]) < _FOLLOWED
        if near and (self.order is not None or self.state is State.HOVERING):
            return setpoint.p, setpoint.v, setpoint.a
        return self.belief[0:3], self.belief[3:6], _ZERO

    @property
    def time_to_contact(self) -> float:
        """Time to the planned contact of the running trajectory [s], 0 after it, infinite where there is none."""
        if self.order is None or self.order.at_end is not AtEnd.CONTACT:
            return inf
        return max(self.order.source.duration - self.elapsed, 0.0)

    def may_touch(self, before: float) -> bool:
        """Something else than air may act: a surface or a wire, from `before` seconds ahead of the planned meeting until the vehicle
        is away from that place; also on the recovery from there, when what was given up holds all the same."""
        if self._meeting is None or self.now < self._meeting[0] - before:
            return False
        return dist(self._meeting[1], self.belief[0:3]) < _AWAY * max(self.vehicle.body_radii)

    @property
    def committed(self) -> bool:
        """Even the hardest brake would end in the surface that the trajectory leads to: contact is the shorter way to rest."""
        return self._needed_deceleration() > _BRAKE_HARD

    def _needed_deceleration(self) -> float:
        """What it takes to stop before the surface that the trajectory leads to [m/s^2], 0 in the open."""
        order = self.order
        if order is None or order.at_end is not AtEnd.CONTACT:
            return 0.0
        now, normal = self.setpoint(), _normal_at_end(order)
        room = dot(axpy(-1.0, order.source.setpoint(order.source.duration).p, now.p), normal) - max(self.vehicle.body_radii)
        closing = max(-dot(now.v, normal), 0.0)
        return BRAKE_PEAK * closing**2 / (2.0 * max(room, 1e-3))

    def _surface_normal(self) -> tuple[float, ...] | None:
        """Outward normal of the surface that the trajectory is about to touch or has touched, None: in the open."""
        order = self.order
        if order is None or order.at_end is not AtEnd.CONTACT or self.elapsed < order.source.duration - _NEAR_CONTACT:
            return None
        return _normal_at_end(order)


def _normal_at_end(order: Order) -> tuple[float, ...]:
    """The direction of the thrust at the end of a trajectory: outward normal of the surface that it touches."""
    a = order.source.setpoint(order.source.duration).a
    f = (a[0], a[1], a[2] + GRAVITY)
    return scale(1.0 / max(norm(f), 1e-6), f)
