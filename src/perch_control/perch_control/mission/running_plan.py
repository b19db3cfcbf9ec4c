"""Planner requests during a powerline plan: a better perch, and ways out of it. [P:V-B]

A plan is based on a map that was made from metres away, with an odometry that has drifted since. As the vehicle comes closer,
the map improves: the plan is shifted with the wire as long as the wire is seen. Where the wire turns out to be elsewhere, a new
plan is made from the running one's own state, so that the reference does not jump.
In between, recoveries are planned from future states, one after the other, so that one is ready for an abort at any time.
The last of them leaves the wire itself, from the vehicle's expected position relative to the newest map: a vehicle that has
missed the wire is not where the plan's own recovery begins.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from perch_core import so3
from perch_core.trajectory import FlatTrajectory, SampledTrajectory, StateSample
from perch_core.values import AtEnd
from perch_control.mission.settings import MissionSettings
from perch_control.mission.values import TICK, Goal, Plan, PlanQuery, Refusal, State, Target
from perch_control.mission.ways_out import DECISION, WaysOut
from perch_control.smooth_position import START_BEFORE_CONTACT

AHEAD_LATENCY = 0.2  # answers to requests during a plan are used so long after the request [s]
_SIGMA_GROWTH = 1.2  # tolerated growth of a wire's uncertainty: out of sight, it grows with every metre flown


class RunningPlan:
    """A powerline plan in flight, with at most one query under way.

    Attributes:
        plan: the plan being flown.
        target: the target that it was made for.
        states: states of the plan, with unit quaternions.
        ways_out: ways out of the plan; closer to the contact, the plan's own recovery is the way out, unless the gripper closes before.
    """

    def __init__(self, plan: Plan, target: Target, settings: MissionSettings, states: SampledTrajectory, replanned_at: float = -math.inf) -> None:
        self.plan, self.target, self.states = plan, target, states
        self.ways_out = WaysOut(plan.start_time, plan.end - settings.way_out_until, settings.way_out_spacing)
        self._settings, self._replanned_at = settings, replanned_at
        self._pending_query: PlanQuery | None = None
        self._departure_requested = False  # the way out from the wire has been requested

    @classmethod
    def from_plan(cls, plan: Plan, target: Target, settings: MissionSettings, replanned_at: float = -math.inf) -> RunningPlan:
        """Return a planner's answer as a plan in flight.

        Raises:
            TypeError: the plan carries no states.
        """
        if isinstance(plan.trajectory, FlatTrajectory):
            raise TypeError("a powerline plan carries states, not polynomials")
        return cls(plan, target, settings, plan.trajectory.normalised(), replanned_at)

    def state(self, time: float) -> StateSample:
        """The plan's state at a time [s]."""
        return self.states.sample(time - self.plan.start_time)

    def query(self, time: float, present: State, target: Target | None, goal: Goal) -> PlanQuery | None:
        """Return the next query; None: there is nothing to request.

        Args:
            time: time of the tick [s].
            present: estimated state of the vehicle.
            target: target by the present map, if certain enough to plan on.
            goal: goal of the mission.
        """
        if self._pending_query is not None:
            return None
        s, soonest = self._settings, time + AHEAD_LATENCY + DECISION
        if goal.replan and target is not None and self._replan_needed(target, time, soonest):
            self._replanned_at = time
            return self._request(soonest, self.state(soonest), target, goal, perch_pose=self._perch_pose(target))
        if (start := self.ways_out.next(soonest)) is not None:
            return self._request(start, self.state(start), self.target, goal, recovery=True)
        if not self._departure_requested and self.plan.end - TICK < soonest < self.plan.end + s.contact_time:
            self._departure_requested = True
            start = max(soonest, self.plan.end)
            return self._request(start, self._continued(time, present, start), self.target if target is None else target, goal,
                                 recovery=True)
        return None

    def answered(self, plan: Plan | Refusal, time: float) -> tuple[Plan | None, RunningPlan | None]:
        """Take the answer to the last query.

        Returns:
            A way out to keep ready, or None; and the plan to fly instead of this one, or None.
        """
        query, self._pending_query = self._pending_query, None
        if query is None:
            return None, None
        refusal = plan.message if isinstance(plan, Refusal) else "the planner answered too late" if plan.start_time <= time else ""
        if query.recovery:
            self.ways_out.answered(query.start_time, refusal)
        if isinstance(plan, Refusal) or refusal:
            return None, None
        if query.recovery:
            return plan, None
        shift = plan.end - self.plan.end
        if abs(shift) > self._settings.replan_shift:
            return None, None  # a detour: the wire is better met as planned, or missed and left
        return None, RunningPlan.from_plan(plan, query.target, self._settings, self._replanned_at)

    def shifted(self, time: float, target: Target | None, goal: Goal) -> RunningPlan | None:
        """Return the same plan, shifted with the wire; None: it is not shifted.

        At the wire, only the position relative to it matters. The odometry has drifted since the map was made, but wire and
        vehicle are estimated in the same frame, so the perch is shifted with the wire. For centimetres a new plan would be worse:
        the optimum of the remainder is not the remainder of the optimum, as N intervals share the remaining time.

        Args:
            time: time of the tick [s].
            target: target by the present map, if certain enough to plan on.
            goal: goal of the mission.
        """
        s = self._settings
        if not goal.replan or target is None or not self._better_observed(target):
            return None
        if not self.plan.start_time + DECISION < time < self.plan.end - START_BEFORE_CONTACT:
            return None
        offset = target.p_WS - self.target.p_WS
        if not s.shift_distance < float(np.linalg.norm(offset)) < s.shift_max:
            return None
        rest = self.states.remainder(time - self.plan.start_time, offset)
        left = self.plan.end - rest.start_time
        following = RunningPlan(Plan(rest, left, AtEnd.RECOVER, float(left)), target, s, rest, self._replanned_at)
        following.ways_out, following._pending_query = self.ways_out, self._pending_query  # kept: centimetres do not matter there
        following._departure_requested = self._departure_requested
        return following

    def _better_observed(self, target: Target) -> bool:
        return target.time > self.target.time and target.position_sigma <= _SIGMA_GROWTH * self.target.position_sigma

    def _replan_needed(self, target: Target, time: float, start: float) -> bool:
        s = self._settings
        return (self._better_observed(target) and self.plan.end - start > s.powerline_replan_until
                and start > self.plan.start_time + DECISION and time - self._replanned_at >= s.powerline_replan_period
                and float(np.linalg.norm(target.p_WS - self.target.p_WS)) > s.shift_max)

    def _perch_pose(self, target: Target) -> tuple[np.ndarray, np.ndarray]:
        """The planned end, shifted with the wire: position [m] and attitude xyzw. It stays on the same side of the wire."""
        end = self.state(self.plan.end)
        return end.p + target.p_WS - self.target.p_WS, end.q

    def _continued(self, time: float, present: State, later: float) -> StateSample:
        """Expected state of the vehicle at a later time [s]: that of the plan, with the present deviation from the plan."""
        now, then = self.state(time), self.state(later)
        turned = so3.quat_multiply(present.q_WB, so3.quat_conjugate(now.q))
        return dataclasses.replace(then, p=then.p + present.p_WB - now.p, v=then.v + present.v_WB - now.v, q=so3.quat_multiply(turned, then.q))

    def _request(self, start: float, x: StateSample, target: Target, goal: Goal, recovery: bool = False,
                 perch_pose: tuple[np.ndarray, np.ndarray] | None = None) -> PlanQuery:
        self._pending_query = PlanQuery(start, x.p, x.v, 0.0, target, goal, latency=AHEAD_LATENCY, state=x, recovery=recovery,
                                        perch_pose=perch_pose)
        return self._pending_query
