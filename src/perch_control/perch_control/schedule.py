"""Trajectories that wait for their start: the next one, and the ways out of the running one."""

from __future__ import annotations

from math import inf
from typing import Any

from perch_control.admission import AtEnd, Order, check_joints
from perch_control.guidance import blended
from perch_control.maneuvers import Maneuvers
from perch_control.modes import State

_EARLY = 0.01  # stamps that are nearer than this are the same [s]
_MOST = 50     # ways out that are kept
_LEAVE_TIME = 0.6  # an abort flies on for at most so long, to where a planned recovery begins [s]


class Schedule:
    """Owns what is pending; starts it on the manoeuvres when its time has come."""

    def __init__(self, maneuvers: Maneuvers) -> None:
        self._maneuvers = maneuvers
        self._pending: tuple[Order, Any, str] | None = None  # a trajectory, the reference made from it, and why it is a way out
        self._ways_out: list[Order] = []  # recoveries out of the running trajectory, in the order of their starts

    @property
    def waiting(self) -> bool:
        """Whether a trajectory is to follow."""
        return self._pending is not None

    def put(self, order: Order, source: Any) -> None:
        """The next trajectory, by the reference made from it."""
        self._pending = order, source, ""

    def drop(self) -> None:
        """Nothing is to follow."""
        self._pending = None

    def keep_ready(self, order: Order) -> None:
        """Keep a recovery that leaves the trajectory with the same id, for an abort before it starts. [P:V-B]

        Raises:
            TrajectoryRefused: it may not be flown.
        """
        m = self._maneuvers
        check_joints(order.source.trajectory)
        known = (m.trajectory_id, order.id)  # the next trajectory has ways out before it is flown
        self._ways_out = [o for o in self._ways_out if o.id in known and o.start >= m.now][-_MOST:] + [order]

    def leave(self, reason: str, law: Any) -> bool:
        """Leave a trajectory by the next way out that was planned of it; False where none is near.

        Until that recovery starts the trajectory is flown on, for `_LEAVE_TIME` at most: braking out of a tilted attitude at
        speed needs more room than a planned way out.
        """
        m, order = self._maneuvers, self._maneuvers.order
        if order is None or (order.recovery_start < 0.0 and order.at_end is not AtEnd.CONTACT):
            return False
        own = order.start + order.recovery_start if order.recovery_start >= 0.0 else inf
        if m.now >= own:
            m.message = f"{reason}; the recovery is under way"
            return True
        ways = [o for o in self._ways_out if o.id == order.id and o.start >= m.now]
        start = min([o.start for o in ways] + [own])  # a plan may end in a recovery of its own
        if start - m.now > _LEAVE_TIME:
            return False
        self._pending = next(((o, law.prepare(o.source, False), reason) for o in ways if o.start == start), None)
        m.message = f"{reason}; planned recovery in {start - m.now:.2f} s"
        return True

    def activate(self, law: Any) -> None:
        """Start the pending trajectory when its time has come, or the recovery that was planned for this vehicle at the wire."""
        m = self._maneuvers
        if self._pending is None:
            self._leave_the_wire(law)
            return
        order, source, leaving = self._pending
        resting = m.state in (State.ARMED, State.ATTACHED)
        if not (resting or m.state in (State.TRACKING, State.HOVERING)):
            self._pending = None
        elif m.now >= order.start:
            self._pending = None
            # From rest there is nothing to continue; in the air the new reference is reached without a jump.
            begin = m.now - order.start
            end = order.recovery_start if order.recovery_start > begin else source.duration  # the wire is met there
            m.track(order, source if resting else blended(m.expected(m.now), source, begin, end), leaving)

    def _leave_the_wire(self, law: Any) -> None:
        """Where the appended recovery is due, take the one that is kept ready for then: it begins where the vehicle is by now.

        Nothing is blended: the reference comes to the vehicle, and the way from there is clear of the wire.
        """
        m, order = self._maneuvers, self._maneuvers.order
        if order is None or order.at_end is not AtEnd.RECOVER or order.recovery_start < 0.0:
            return
        own = order.start + order.recovery_start
        way = next((o for o in self._ways_out if o.id == order.id and own - _EARLY <= o.start <= m.now), None)
        if way is not None:
            m.track(way, law.prepare(way.source, False))
