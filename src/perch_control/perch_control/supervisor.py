"""The supervisor: what is not as planned leads to a hover, a recovery or a descent, always with the reason said."""

from __future__ import annotations

from collections.abc import Callable

from perch_core.vector3 import norm
from perch_control.admission import AtEnd, Order
from perch_control.maneuvers import Maneuvers
from perch_control.modes import State
from perch_control.monitors import CarriedTilted, TrackingMonitor
from perch_control.debounce import Debounce
from perch_control.recovery import TIMEOUT, Recovery
from perch_control.reference import Setpoint
from perch_control.weak_landing import WeakLanding

_COASTING, _DIVERGED = 2, 3  # perch_msgs/EstimatorStatus
_COASTING_HOVER = 1.0  # no VIO for so long: hover; the position drifts by centimetres until then [s]
_COASTING_LAND = 3.0   # the same: descend without position [s]
_FENCE_SLACK = 1.0     # so far outside the fence: land, since a hover has not come back [m]
_MISSED_SPEED = 1.0    # faster than this after the planned contact: it was missed; a contact that may hold is slower [m/s]
_GROUND_GAP = 0.12     # the descending reference is so far below the vehicle ... [m]
_GROUND_TIME = 0.25    # ... for so long: on the ground [s]


class Supervisor:
    """Watches a flight and acts on it through its manoeuvres. Owns the monitors, which start anew with each state."""

    def __init__(self, maneuvers: Maneuvers, leave: Callable[[str], bool]) -> None:
        """`leave`: takes the reason for which a trajectory is left by a planned way out, and returns whether there is one."""
        self._maneuvers, self._leave = maneuvers, leave
        self._carried: CarriedTilted | None = None  # while motors run
        self.restart()

    def restart(self) -> None:
        """Forget what has been seen so far: the state or the settings have changed."""
        m = self._maneuvers
        self._state = m.state
        self._monitor = TrackingMonitor(m.settings, m.vehicle.body_rate_max)
        self._ground = Debounce(_GROUND_TIME)

    def estimator(self, state: int, vio_age: float, message: str) -> None:
        """Act on the estimator's health: state as in `perch_msgs/EstimatorStatus`, age of the last VIO measurement [s]."""
        m = self._maneuvers
        if state == _DIVERGED:
            m.descend(f"the estimator has diverged: {message}", moving=False)
        elif state == _COASTING and vio_age > _COASTING_LAND:
            m.descend(f"no VIO for {vio_age:.1f} s")
        elif state == _COASTING and vio_age > _COASTING_HOVER:
            self._give_up(f"no VIO for {vio_age:.1f} s")

    def _give_up(self, reason: str) -> None:
        """Leave a trajectory by a planned way out, or brake; where even the hardest brake would end in the surface, go on."""
        m = self._maneuvers
        if m.state is State.TRACKING and not self._leave(reason) and not m.committed:
            m.stop(f"hover: {reason}")

    def imu(self, stamp: float, gyro: tuple[float, ...], accel: tuple[float, ...]) -> None:
        """Take an IMU sample: time [s], in B [rad/s, m/s^2]. Running motors that only press the vehicle onto something are stopped."""
        m = self._maneuvers
        if not m.flying:
            self._carried = None
            return
        if self._carried is None:
            self._carried = CarriedTilted()
        self._carried.imu(stamp, gyro, accel)
        if self._carried.lasts:
            m.motors_off(State.FAILED, "at rest and tilted with the motors running: something else carries the vehicle")

    @property
    def tilted(self) -> bool:
        """What carries the vehicle, by the IMU, does not push along b3."""
        return self._carried is not None and self._carried.tilted

    def act(self, margin: float) -> None:
        """Watch one step of a flight.

        Args:
            margin: thrust margin of the last command.
        """
        m = self._maneuvers
        if m.state is not self._state:
            self.restart()
        if isinstance(m.source, WeakLanding):
            m.source.update(m.belief, m.specific_thrust_max)
            return
        asked = m.beyond_what_is_left() if m.weak else ""
        if asked:
            m.land_weak(asked)
            return
        if isinstance(m.source, Recovery):
            m.source.update(m.belief, m.elapsed)
            if m.source.finished:
                m.settle("recovered: hovering")
            elif m.elapsed > TIMEOUT:
                m.land("landing: the recovery did not come to rest")
            return
        if m.state is State.LANDING:
            return
        deviation = self._monitor.deviation(m.belief, m.setpoint(), m.now)
        outside = self._monitor.outside(m.belief[0:3])
        if deviation:
            m.recover(deviation)
        elif outside > _FENCE_SLACK:
            m.land(f"landing: {outside:.1f} m outside the geofence")
        elif outside > 0.0 and m.state is State.TRACKING and not m.committed:
            m.stop(f"hover: {outside:.1f} m outside the geofence")
        elif self._monitor.exhausted(margin, m.now):
            m.land("landing: the rotors are at their limit")
        elif m.order is not None:
            self._at_end(m.order, m.elapsed - m.order.source.duration)
        elif m.elapsed > m.settings.silence_time:
            m.land(f"landing: no order for {m.settings.silence_time:.0f} s")

    def _at_end(self, order: Order, over: float) -> None:
        if order.at_end is AtEnd.CONTACT:
            speed = norm(self._maneuvers.belief[3:6])
            if over > order.contact_time:
                self._maneuvers.recover("contact was missed")
            elif over > 0.0 and speed > _MISSED_SPEED:  # what holds does not fall
                self._maneuvers.recover(f"contact was missed, falling with {speed:.1f} m/s")
        elif over >= 0.0:
            if order.at_end is AtEnd.LAND:
                self._maneuvers.land(f"landing after trajectory {order.id}")
            else:
                self._maneuvers.stop(f"hovering at the end of trajectory {order.id}")

    def landed(self, setpoint: Setpoint) -> bool:
        """The reference has descended away from under the vehicle for a while: the ground carries it."""
        m = self._maneuvers
        if isinstance(m.source, WeakLanding):
            resting = m.source.resting(m.belief)
        else:
            resting = abs(m.belief[5]) < 0.1 and m.belief[2] - setpoint.p[2] > _GROUND_GAP
        return m.state is State.LANDING and self._ground.update(resting, m.now)
