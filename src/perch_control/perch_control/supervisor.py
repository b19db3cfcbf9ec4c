"""Supervisor: a deviation from the plan leads to a hover, a recovery or a descent, always with a reported reason."""

from __future__ import annotations

from collections.abc import Callable

from perch_core.vector3 import axes_of, norm
from perch_core.vehicle import GRAVITY, Vehicle
from perch_control.admission import AtEnd, Order
from perch_control.debounce import Debounce
from perch_control.flight_settings import FlightSettings
from perch_control.flight_state import FlightState
from perch_control.guidance import BRAKE_HARD
from perch_control.maneuvers import hover_after_recovery, landing, landing_weak, motors_off, recovered, stopped
from perch_control.modes import State
from perch_control.monitors import TiltedContactMonitor, TrackingMonitor
from perch_control.recovery import TIMEOUT, Recovery
from perch_control.reference import ByState, Setpoint, Source, peak_thrust
from perch_control.rotor_health import HOVER_MIN, RESERVE
from perch_control.weak_landing import WeakLanding

_FENCE_SLACK = 1.0   # so far outside the fence: land, since a hover has not come back [m]
_MISSED_SPEED = 1.0  # faster than this after the planned contact: it was missed; a contact that may hold is slower [m/s]
_GROUND_GAP = 0.12   # the descending reference is so far below the vehicle ... [m]
_GROUND_SPEED = 0.1  # ... not moving faster than this up or down ... [m/s]
_GROUND_TIME = 0.25  # ... for so long: on the ground [s]
_LANDING_TIME = 30.0  # a landing takes no longer than through the whole geofence, and this [s]
_UPRIGHT = 0.7       # cosine of the tilt beyond which a recovery or a perch goes on before a landing on weak rotors begins


def committed(x: FlightState) -> bool:
    """Whether even the hardest brake would end in the surface ahead, so that the contact is the shorter way to rest."""
    return x.stopping[1] > BRAKE_HARD


class Supervisor:
    """Monitors a flight and changes its mode where necessary. Owns the monitors, which restart with each mode.

    Attributes:
        settings: limits; `restart` is called after a change.
    """

    def __init__(self, vehicle: Vehicle, settings: FlightSettings) -> None:
        self.settings, self._rate_max = settings, vehicle.body_rate_max
        self._tilted_contact: TiltedContactMonitor | None = None  # while motors run
        self._thrust_check: tuple[Source, Vehicle, bool] | None = None  # whether this reference exceeds this vehicle's thrust
        self._cached_setpoint: tuple[Source | None, float, Setpoint] = None, 0.0, Setpoint((0.0, 0.0, 0.0))
        self.restart(State.DISARMED)

    def restart(self, mode: State) -> None:
        """Reset the monitors after a change of the mode or of the settings."""
        self._mode = mode
        self._monitor = TrackingMonitor(self.settings, self._rate_max)
        self._ground = Debounce(_GROUND_TIME)

    def setpoint(self, x: FlightState) -> Setpoint:
        """Present setpoint of the running reference; cached, as supervisor and control step use the same one."""
        source, t = x.source, x.now - x.start
        if self._cached_setpoint[0] is not source or self._cached_setpoint[1] != t or isinstance(source, ByState):
            self._cached_setpoint = source, t, source.setpoint(t)
        return self._cached_setpoint[2]

    def imu(self, x: FlightState, stamp: float, gyro: tuple[float, ...], accel: tuple[float, ...]) -> FlightState:
        """Take an IMU sample: time [s], in B [rad/s, m/s^2]. Motors that only press the vehicle onto an obstacle are stopped."""
        if not x.flying:
            self._tilted_contact = None
            return x
        if self._tilted_contact is None:
            self._tilted_contact = TiltedContactMonitor()
        self._tilted_contact.imu(stamp, gyro, accel)
        if self._tilted_contact.confirmed:
            return motors_off(x, State.FAILED, "at rest and tilted with the motors running: something else carries the vehicle; motors off")
        return x

    @property
    def tilted(self) -> bool:
        """Whether the specific force, by the IMU, does not point along b3."""
        return self._tilted_contact is not None and self._tilted_contact.tilted

    def act(self, x: FlightState, waiting: bool) -> FlightState:
        """Monitor one step of a flight; return the state, in another mode where necessary. `waiting`: whether a trajectory is pending."""
        if x.mode is not self._mode:
            self.restart(x.mode)
        if x.weak and not isinstance(x.source, WeakLanding) and (reason := self._insufficient_thrust_reason(x)):
            return landing_weak(x, reason, self.settings.land_speed)
        x = MONITORS[x.mode](self, x)
        if x.mode is State.HOVERING and x.elapsed > self.settings.silence_time and not waiting:
            return landing(x, f"landing: no order for {self.settings.silence_time:.0f} s", self.settings.land_speed)
        return x

    def _landing(self, x: FlightState) -> FlightState:
        if isinstance(x.source, WeakLanding):
            x.source.update(x.state_estimate, x.specific_thrust_max)
        return x

    def _hovering(self, x: FlightState) -> FlightState:
        return landing(x, "landing as commanded", self.settings.land_speed) if x.land_requested else self._on_reference(x)

    def _recovering(self, x: FlightState) -> FlightState:
        source = x.source
        if not isinstance(source, Recovery):
            return self._on_reference(x)  # a planned way out
        source.update(x.state_estimate, x.elapsed)
        if source.finished:
            if x.low:
                return landing(x, "landing: the recovery ended at the ground", self.settings.land_speed)
            return hover_after_recovery(x, "recovered: hovering")
        if x.elapsed > TIMEOUT:
            return landing(x, "landing: the recovery did not come to rest", self.settings.land_speed)
        return x

    def _on_reference(self, x: FlightState) -> FlightState:
        speed = self.settings.land_speed
        deviation = self._monitor.deviation(x.state_estimate, self.setpoint(x), x.now)
        outside = self._monitor.outside(x.state_estimate[0:3])
        if deviation:
            return recovered(x, deviation)
        if outside > _FENCE_SLACK:
            return landing(x, f"landing: {outside:.1f} m outside the geofence", speed)
        if outside > 0.0 and x.mode is State.TRACKING and not committed(x):
            where = f"{outside:.1f} m outside the geofence"
            after = stopped(x, f"hover: {where}")  # tilted or at a surface, the vehicle recovers first
            return landing(x, f"landing: {where}", speed) if x.low and after.mode is State.HOVERING else after
        if self._monitor.exhausted(x.margin, x.now):
            return landing(x, "landing: the rotors are at their limit", speed)
        if x.order is not None:
            return self._at_end(x, x.order, x.elapsed - x.order.source.duration)
        return x

    def _at_end(self, x: FlightState, order: Order, over: float) -> FlightState:
        if order.at_end is AtEnd.CONTACT:
            speed = norm(x.state_estimate[3:6])
            if over > order.contact_time:
                return recovered(x, "contact was missed")
            if over > 0.0 and speed > _MISSED_SPEED:  # an attached vehicle does not fall
                return recovered(x, f"contact was missed, falling with {speed:.1f} m/s")
        elif over >= 0.0:
            if order.at_end is AtEnd.LAND:
                return landing(x, f"landing after trajectory {order.id}", self.settings.land_speed)
            return stopped(x, f"hovering at the end of trajectory {order.id}")
        return x

    def _insufficient_thrust_reason(self, x: FlightState) -> str:
        """Return why weak rotors cannot continue the running manoeuvre; empty: they can."""
        left = x.specific_thrust_max
        limit_text = f"at most {100.0 * left / GRAVITY:.0f} % of the weight is left"
        upright = axes_of(x.state_estimate[6:10])[2][2] >= _UPRIGHT
        if x.order is not None:
            if upright and x.order.at_end is AtEnd.CONTACT:
                return f"{limit_text}, too little to recover from a missed contact"
            if self._thrust_check is None or self._thrust_check[0] is not x.source or self._thrust_check[1] is not x.vehicle:
                self._thrust_check = x.source, x.vehicle, peak_thrust(x.source, x.elapsed) > RESERVE * left
            return f"{limit_text}, less than the trajectory needs" if self._thrust_check[2] else ""
        if x.mode is State.RECOVERING and not upright:
            return ""
        return limit_text if left < HOVER_MIN * GRAVITY else ""

    def landed(self, x: FlightState, setpoint: Setpoint) -> bool:
        """Whether the ground carries the vehicle: for some time it has not followed the descent."""
        if x.mode is not State.LANDING:
            return False
        if isinstance(x.source, WeakLanding):
            resting = x.source.resting(x.state_estimate)
        else:
            height, climb = x.state_estimate[2], x.state_estimate[5]
            resting = abs(climb) < min(_GROUND_SPEED, 0.5 * self.settings.land_speed) and height - setpoint.p[2] > _GROUND_GAP
        return self._ground.update(resting, x.now)

    @property
    def longest_landing(self) -> float:
        """Time after which a landing, or a descent without position, has not detected its ground contact [s]."""
        s = self.settings
        return (s.fence_high[2] - s.fence_low[2]) / s.land_speed + _LANDING_TIME


MONITORS: dict[State, Callable[[Supervisor, FlightState], FlightState]] = {
    State.TRACKING: Supervisor._on_reference,
    State.HOVERING: Supervisor._hovering,
    State.RECOVERING: Supervisor._recovering,
    State.LANDING: Supervisor._landing,
}
"""Monitoring function of each mode of flight."""
