"""Trajectories that wait for their start: the next one, and the ways out (planned recoveries) of the running one."""

from __future__ import annotations

from math import dist, inf

from perch_control.admission import START_GAP, AtEnd, Order, TrajectoryRefused, check_joints, check_start
from perch_control.flight_state import FlightState
from perch_control.guidance import blended
from perch_control.maneuvers import tracked
from perch_control.modes import State

_STAMP_TOLERANCE = 0.01  # stamps that are nearer than this are the same [s]
_WAYS_OUT_MAX = 50       # ways out that are kept
_LEAVE_TIME = 0.6        # longest time for which an abort continues the trajectory to the start of a planned recovery [s]


class Schedule:
    """Owns the pending trajectories, and starts each at its start time."""

    def __init__(self) -> None:
        self._pending: tuple[Order, str] | None = None  # a trajectory, and why it is a way out
        self._last: tuple[Order, str] | None = None  # the running trajectory, and why it is left by the recovery appended to it
        self._ways_out: list[Order] = []  # recoveries out of the running trajectory, in the order of their starts

    @property
    def waiting(self) -> bool:
        """Whether a trajectory is pending."""
        return self._pending is not None

    def leaving(self, x: FlightState) -> bool:
        """Whether the running trajectory is about to be left by a way out."""
        return self._pending is not None and bool(self._pending[1]) or bool(self._leaving_reason(x))

    def set_next(self, order: Order) -> None:
        """Set the next trajectory."""
        self._pending = order, ""

    def clear(self) -> None:
        """Discard the pending trajectory, and a way out that was to be taken."""
        self._pending = self._last = None

    def keep_ready(self, x: FlightState, order: Order) -> None:
        """Keep a recovery that leaves the trajectory with the same id, for an abort before that recovery's start. [P:V-B]

        Raises:
            TrajectoryRefused: the recovery is not continuous.
        """
        check_joints(order.source.trajectory)
        ids = (x.trajectory_id, order.id)  # the next trajectory has ways out before it is flown
        self._ways_out = [o for o in self._ways_out if o.id in ids and o.start >= x.now][-_WAYS_OUT_MAX:] + [order]

    def leave_by_way_out(self, x: FlightState, reason: str) -> FlightState | None:
        """Leave the running trajectory by its next planned way out; return None where none starts soon.

        The trajectory is continued until that recovery starts, for `_LEAVE_TIME` at most: braking out of a tilted attitude at
        speed needs more space than a planned way out.
        """
        order = x.order
        if order is None or (order.recovery_start < 0.0 and order.at_end is not AtEnd.CONTACT):
            return None
        appended = order.start + order.recovery_start if order.recovery_start >= 0.0 else inf
        if x.now >= appended:
            self._pending, self._last = None, (order, reason)
            return x._replace(message=f"{reason}; the recovery is running")
        ways = [o for o in self._ways_out if o.id == order.id and o.start >= x.now
                and dist(o.source.setpoint(0.0).p, x.expected(o.start).p) < START_GAP]
        start = min([o.start for o in ways] + [appended])  # a plan may end in a recovery of its own
        if start - x.now > _LEAVE_TIME:
            return None
        self._pending = next(((o, reason) for o in ways if o.start == start), None)
        self._last = (order, reason) if self._pending is None else None
        return x._replace(message=f"{reason}; planned recovery in {start - x.now:.2f} s")

    def activated(self, x: FlightState) -> FlightState:
        """Start the pending trajectory at its start time; without one, switch to the recovery from the wire where this is due."""
        if self._pending is None:
            return self._switched_to_recovery(x)
        order, leaving = self._pending
        source = order.source
        resting = x.mode in (State.ARMED, State.ATTACHED)
        if (resting or x.mode is State.HOVERING) and x.now >= order.start:  # the vehicle may have been stopped elsewhere since it was accepted
            try:
                check_start(order, x.now, x.expected(x.now))
            except TrajectoryRefused as error:
                self._pending = None
                return x._replace(message=f"trajectory {order.id} was not started: it {error}")
        if not (resting or x.mode in (State.TRACKING, State.HOVERING)) or not (leaving or x.accepts(order)):
            self._pending = None
        elif x.now >= order.start:
            self._pending = None
            # From rest there is nothing to continue; in the air the new reference is reached without a jump.
            begin = x.now - order.start
            end = order.recovery_start if order.recovery_start > begin else source.duration  # the wire is met there
            return tracked(x, order, source if resting else blended(x.expected(x.now), source, begin, end), leaving)
        return x

    def _leaving_reason(self, x: FlightState) -> str:
        """Return why the running trajectory is left by its appended recovery; empty: it is not."""
        return self._last[1] if self._last is not None and self._last[0] is x.order else ""

    def _switched_to_recovery(self, x: FlightState) -> FlightState:
        """When the appended recovery is due, switch to a recovery kept for that time, if it is near the vehicle.

        It is not blended: it was planned from the vehicle's expected state, and its path is clear of the wire. Without one, the
        trajectory continues; where it is being left, the mode becomes RECOVERING.
        """
        order = x.order
        if order is None or order.recovery_start < 0.0:
            return x
        appended, leaving = order.start + order.recovery_start, self._leaving_reason(x)
        if order.at_end is AtEnd.RECOVER:
            for way in self._ways_out:
                due = way.id == order.id and appended - _STAMP_TOLERANCE <= way.start <= x.now
                if due and dist(way.source.setpoint(x.now - way.start).p, x.state_estimate[0:3]) < START_GAP:
                    return tracked(x, way, way.source, leaving)
        return tracked(x, order, x.source, leaving) if leaving and x.now >= appended and x.mode is State.TRACKING else x
