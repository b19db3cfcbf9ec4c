"""State of a flight between two steps, and the quantities that follow from it."""

from __future__ import annotations

from math import dist, inf, sqrt
from typing import NamedTuple

from perch_core.vector3 import axpy, dot, norm, scale
from perch_core.vehicle import GRAVITY, Vehicle
from perch_control.admission import AtEnd, Order
from perch_control.descent import BlindDescent
from perch_control.guidance import BRAKE_PEAK, Hold
from perch_control.inner_loop import InnerLoopEstimate, rotors_at_rest
from perch_control.modes import FLYING, State
from perch_control.reference import Setpoint, Source
from perch_control.rotor_lag import RotorEstimate

_NEAR_CONTACT = 0.35  # an abort so shortly before a contact pushes away from the surface first [s]
_LOW = 0.25           # below this height a manoeuvre ends in a landing, as a hover would touch the ground [m]
AIRBORNE = 0.1        # so far above the place of arming, the ground no longer carries the vehicle [m]
_CLEAR = 2.0          # distance from the place of a contact beyond which nothing there holds the vehicle [body radii]


class FlightState(NamedTuple):
    """State of a flight between two steps; every change creates a new object.

    Attributes:
        vehicle: the vehicle model in use; `weak`: whether its rotors have less thrust than those of the vehicle file.
        mode, message: as published.
        source, start: running reference and the time at which it began [s].
        order, trajectory_id: the tracked trajectory, or the planned way out of it while RECOVERING, else None; the id is kept
            until the next trajectory or until the motors stop.
        planned_contact: time and position of the planned contact with a surface or a wire [s, m]; None: there is none.
        attached_to: normal of the surface that carries the vehicle; None: there is none.
        blind: the running descent without position; None: there is none.
        ground: height at which the vehicle was armed [m]; `airborne`: whether it has been clear of the ground since, or has
            left a perch.
        land_requested: whether a landing was commanded or interrupted; a hover then becomes a landing.
        left_early: whether a trajectory was left before its end; no perch begins during the brake.
        events: events since the last step, for the log.
        now: time of the step [s].
        state_estimate: state used for control, 13 floats: odometry, or its prediction while odometry is refused.
        last_odometry: stamp [s] and state of the last accepted odometry sample.
        rotors: estimate of the rotor speeds, or of the inner loop, by the lag model.
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
    planned_contact: tuple[float, tuple[float, ...]] | None
    attached_to: tuple[float, ...] | None
    blind: BlindDescent | None
    ground: float
    airborne: bool
    land_requested: bool
    left_early: bool
    events: tuple[str, ...]
    # the last seven change in each step
    now: float
    state_estimate: tuple[float, ...]
    last_odometry: tuple[float, tuple[float, ...]]
    rotors: RotorEstimate | InnerLoopEstimate
    margin: float
    spare: float
    position_error: float

    @classmethod
    def disarmed(cls, vehicle: Vehicle) -> FlightState:
        """Return the initial state: a disarmed vehicle without any sensor data."""
        return cls(vehicle, False, State.DISARMED, "disarmed", Hold(Setpoint((0.0, 0.0, 0.0))), 0.0, None, 0, None, None, None, -inf, False, False, False, (),
                   0.0, (), (0.0, ()), rotors_at_rest(vehicle), 1.0, 1.0, 0.0)

    def sensed(self, now: float, state_estimate: tuple[float, ...], last_odometry: tuple[float, tuple[float, ...]],
               rotors: RotorEstimate | InnerLoopEstimate) -> FlightState:
        """As `_replace`, but faster, since it is called in every step."""
        return FlightState._make(self[:-7] + (now, state_estimate, last_odometry, rotors) + self[-3:])

    def commanded(self, rotors: RotorEstimate | InnerLoopEstimate, margin: float, spare: float, position_error: float) -> FlightState:
        """As `_replace`, but faster, since it is called in every step."""
        return FlightState._make(self[:-4] + (rotors, margin, spare, position_error))

    @property
    def flying(self) -> bool:
        """Whether the vehicle is in a mode of flight."""
        return self.mode in FLYING

    @property
    def at_ground(self) -> bool:
        """Whether the ground may carry the vehicle: it is low, and has not been airborne or is neither tracking nor hovering."""
        clear = self.airborne and self.mode in (State.TRACKING, State.HOVERING)
        return not clear and self.state_estimate[2] - self.ground < AIRBORNE

    @property
    def low(self) -> bool:
        """Whether the vehicle is too close to the height at which it was armed for a hover, above or below it."""
        return abs(self.state_estimate[2] - self.ground) < _LOW

    @property
    def braking(self) -> bool:
        """Whether the vehicle brakes to a hover from a trajectory that was left before its end."""
        return self.left_early and self.elapsed < self.source.duration

    def accepts(self, order: Order) -> bool:
        """Whether a trajectory may begin: while `braking`, only one that ends in a hover."""
        return not self.braking or order.at_end is AtEnd.HOLD

    @property
    def elapsed(self) -> float:
        """Time since the running reference began [s]."""
        return self.now - self.start

    def setpoint(self, ahead: float = 0.0) -> Setpoint:
        """Setpoint of the running reference `ahead` seconds from now."""
        return self.source.setpoint(self.now - self.start + ahead)

    def expected(self, time: float) -> Setpoint:
        """Expected setpoint at a time [s]: that of the reference while tracking or hovering, otherwise the present motion."""
        if self.mode in (State.TRACKING, State.HOVERING):
            return self.source.setpoint(time - self.start)
        return Setpoint(self.state_estimate[0:3], self.state_estimate[3:6])

    @property
    def specific_thrust_max(self) -> float:
        """Greatest collective thrust / mass of the vehicle model in use [m/s^2]."""
        return 4.0 * self.vehicle.thrust_max / self.vehicle.mass

    @property
    def time_to_contact(self) -> float:
        """Time to the planned contact of the running trajectory [s], 0 after it, infinite where there is none."""
        if self.order is None or self.order.at_end is not AtEnd.CONTACT:
            return inf
        return max(self.order.source.duration - self.elapsed, 0.0)

    def may_touch(self, before: float) -> bool:
        """Whether a surface or a wire may act on the vehicle: from `before` seconds before the planned contact until the vehicle
        is away from that place; also during the recovery from there, as an abandoned perch may hold after all."""
        if self.planned_contact is None or self.now < self.planned_contact[0] - before:
            return False
        return dist(self.planned_contact[1], self.state_estimate[0:3]) < _CLEAR * max(self.vehicle.body_radii)

    @property
    def stopping(self) -> tuple[float, float]:
        """Longest duration T of a brake that ends before the surface that the trajectory leads to [s], infinite without one, and
        its deceleration [m/s^2]. With speed v and acceleration a towards the surface, it covers v T / 2 + a T^2 / 10."""
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
        """Outward normal of the surface that the trajectory is about to touch or has touched; None: there is none."""
        order = self.order
        if order is None or order.at_end is not AtEnd.CONTACT or self.elapsed < order.source.duration - _NEAR_CONTACT:
            return None
        return _normal_at_end(order)


def _normal_at_end(order: Order) -> tuple[float, ...]:
    """The direction of the thrust at the end of a trajectory: outward normal of the surface that it touches."""
    a = order.source.setpoint(order.source.duration).a
    f = (a[0], a[1], a[2] + GRAVITY)
    return scale(1.0 / max(norm(f), 1e-6), f)
