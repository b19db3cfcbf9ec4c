"""What holds between two steps of a flight, and what follows from it."""

from __future__ import annotations

from math import dist, inf, sqrt
from typing import NamedTuple

from perch_core.vector3 import axpy, dot, norm, scale
from perch_core.vehicle import GRAVITY, Vehicle
from perch_control.admission import AtEnd, Order
from perch_control.descent import BlindDescent
from perch_control.guidance import BRAKE_PEAK, Hold
from perch_control.inner_loop import InnerLoopEstimate, stopped
from perch_control.modes import FLYING, State
from perch_control.reference import Setpoint, Source
from perch_control.rotor_lag import RotorEstimate

_NEAR_CONTACT = 0.35  # an abort so shortly before a contact pushes away from the surface first [s]
_LOW = 0.25           # what ends nearer to the ground lands: a hover would touch it [m]
AIRBORNE = 0.1        # so far above where it was armed, the ground no longer carries the vehicle [m]
_AWAY = 2.0           # radii of the body from the place of a contact at which nothing there holds the vehicle


class FlightState(NamedTuple):
    """A flight between two steps; every change makes a new one.

    Attributes:
        vehicle: as it is believed to be; `weak`: its rotors give less than its file says.
        mode, message: as published.
        source, start: running reference and the time at which it began [s].
        order, trajectory_id: trajectory that is being tracked, or a planned way out of it while RECOVERING, else None; the id stays until
            another one or the motors' stop.
        meeting: when and where a surface or a wire is met [s, m].
        attached_to: normal of the surface that carries the vehicle, None: none does.
        blind: the descent without position that is under way.
        ground: height at which the vehicle was armed [m]; `airborne`: it has been clear of it since.
        lands: it was ordered to land, or was landing: a hover becomes a landing.
        stops: what was flown has been left before its end: no perch goes on from the brake.
        events: what has happened since the last step.
        now: time of the step [s].
        belief: state that is flown on, 13 floats: odometry, or its prediction while odometry is refused.
        seen: stamp [s] and state of the last odometry sample that was accepted.
        rotors: rotor speeds, or the inner loop, as the lag model has them.
        margin: (max - commanded) / max of the most loaded rotor; `spare`: its mean in hover.
        position_error: distance to the reference [m].
    """

    vehicle: Vehicle
    weak: bool
    mode: State
    message: str
    source: Source
    start: float
    order: Order | None
    trajectory_id: int
    meeting: tuple[float, tuple[float, ...]] | None
    attached_to: tuple[float, ...] | None
    blind: BlindDescent | None
    ground: float
    airborne: bool
    lands: bool
    stops: bool
    events: tuple[str, ...]
    # the last seven change in each step
    now: float
    belief: tuple[float, ...]
    seen: tuple[float, tuple[float, ...]]
    rotors: RotorEstimate | InnerLoopEstimate
    margin: float
    spare: float
    position_error: float

    @classmethod
    def disarmed(cls, vehicle: Vehicle) -> FlightState:
        """A vehicle of which nothing is known but its file."""
        return cls(vehicle, False, State.DISARMED, "disarmed", Hold(Setpoint((0.0, 0.0, 0.0))), 0.0, None, 0, None, None, None, -inf, False, False, False, (),
                   0.0, (), (0.0, ()), stopped(vehicle), 1.0, 1.0, 0.0)

    def sensed(self, now: float, belief: tuple[float, ...], seen: tuple[float, tuple[float, ...]],
               rotors: RotorEstimate | InnerLoopEstimate) -> FlightState:
        """As `_replace`, in less time: every step does it."""
        return FlightState._make(self[:-7] + (now, belief, seen, rotors) + self[-3:])

    def commanded(self, rotors: RotorEstimate | InnerLoopEstimate, margin: float, spare: float, position_error: float) -> FlightState:
        """As `_replace`, in less time: every step does it."""
        return FlightState._make(self[:-4] + (rotors, margin, spare, position_error))

    @property
    def flying(self) -> bool:
        """The motors carry the vehicle."""
        return self.mode in FLYING

    @property
    def at_ground(self) -> bool:
        """The ground may carry the vehicle: it has not left it yet, or is on the way down to it."""
        return not (self.airborne and self.mode in (State.TRACKING, State.HOVERING)) and self.belief[2] - self.ground < AIRBORNE

    @property
    def low(self) -> bool:
        """The ground on which it was armed is too near for a hover; what is further below is not on it."""
        return abs(self.belief[2] - self.ground) < _LOW

    @property
    def braking(self) -> bool:
        """To a hover, out of what was left before its end."""
        return self.stops and self.elapsed < self.source.duration

    def takes(self, order: Order) -> bool:
        """Whether a trajectory may begin: what was left before its end is braked to a hover, not flown on."""
        return not self.braking or order.at_end is AtEnd.HOLD

    @property
    def elapsed(self) -> float:
        """Time since the running reference began [s]."""
        return self.now - self.start

    def setpoint(self, ahead: float = 0.0) -> Setpoint:
        """The running reference `ahead` seconds from now."""
        return self.source.setpoint(self.now - self.start + ahead)

    def expected(self, time: float) -> Setpoint:
        """Where the vehicle will be at a time [s]: on its reference in flight, where it is on the ground."""
        if self.mode in (State.TRACKING, State.HOVERING):
            return self.source.setpoint(time - self.start)
        return Setpoint(self.belief[0:3], self.belief[3:6])

    @property
    def specific_thrust_max(self) -> float:
        """Greatest collective thrust / mass, as believed [m/s^2]."""
        return 4.0 * self.vehicle.thrust_max / self.vehicle.mass

    @property
    def time_to_contact(self) -> float:
        """Time to the planned contact of the running trajectory [s], 0 after it, infinite where there is none."""
        if self.order is None or self.order.at_end is not AtEnd.CONTACT:
            return inf
        return max(self.order.source.duration - self.elapsed, 0.0)

    def may_touch(self, before: float) -> bool:
        """Something else than air may act: a surface or a wire, from `before` seconds ahead of the planned meeting until the vehicle
        is away from that place; also on the recovery from there, when what was given up holds all the same."""
        if self.meeting is None or self.now < self.meeting[0] - before:
            return False
        return dist(self.meeting[1], self.belief[0:3]) < _AWAY * max(self.vehicle.body_radii)

    @property
    def stopping(self) -> tuple[float, float]:
        """Longest duration T of a brake that ends before the surface that the trajectory leads to [s], infinite in the open; and the
        deceleration [m/s^2]. v T / 2 + a T^2 / 10 is the room, with speed v and acceleration a towards the surface."""
        order = self.order
        if order is None or order.at_end is not AtEnd.CONTACT:
            return inf, 0.0
        now, normal = self.setpoint(), _normal_at_end(order)
        room = max(dot(axpy(-1.0, order.source.setpoint(order.source.duration).p, now.p), normal) - max(self.vehicle.body_radii), 1e-3)
        v, a = -dot(now.v, normal), max(-dot(now.a, normal), 0.0)
        if v <= 0.0:
            return inf, 0.0
        longest = 4.0 * room / (v + sqrt(v**2 + 1.6 * a * room))
        return longest, BRAKE_PEAK * v / longest

    @property
    def surface_normal(self) -> tuple[float, ...] | None:
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
