"""Planner requests during a perch on a surface: the same perch to the target as seen from closer (M's future work), and ways out
of it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from perch_control.mission.settings import MissionSettings
from perch_control.mission.values import Goal, Plan, PlanQuery, Refusal, Target
from perch_control.mission.ways_out import DECISION, SPACING_MIN, WaysOut


@dataclass(frozen=True)
class RunningPerch:
    """A surface plan in flight.

    Attributes:
        plan: the plan being flown.
        target: the target that it was made for.
        requested_target: target of the newest query.
        requested_at: time of the newest query [s].
        ways_out: ways out of the plan.
    """

    plan: Plan
    target: Target
    requested_target: Target
    ways_out: WaysOut
    requested_at: float = -math.inf

    @classmethod
    def from_plan(cls, plan: Plan, target: Target, settings: MissionSettings) -> RunningPerch:
        """Return a planner's answer as a plan in flight; there is no way out within `contact_early` before the contact."""
        return cls(plan, target, target, WaysOut(plan.start_time - SPACING_MIN, plan.end - settings.contact_early, SPACING_MIN))

    def way_out(self, time: float, goal: Goal, settings: MissionSettings) -> PlanQuery | None:
        """Return the query for the next way out at the time of a tick [s]; None: no further one is needed."""
        start, zero = self.ways_out.next(time + settings.planner_latency + DECISION), np.zeros(3)
        if start is None:
            return None
        return PlanQuery(start, zero, zero, 0.0, self.target, goal, settings.planner_latency, current=self.plan.trajectory, recovery=True)

    def accepted(self, answer: Plan | Refusal | None, time: float, settings: MissionSettings) -> RunningPerch | None:
        """Return the plan to fly, from the answer to the newest query: a new one, or this one if that is a detour; None: none."""
        if not isinstance(answer, Plan) or answer.start_time <= time:
            return None
        if abs(answer.end - self.plan.end) > settings.replan_shift:
            return self  # a detour: the running plan is better
        return replace(RunningPerch.from_plan(answer, self.requested_target, settings), requested_at=self.requested_at)

    def query(self, time: float, target: Target | None, goal: Goal, settings: MissionSettings,
              start: float, latency: float) -> tuple[RunningPerch, PlanQuery] | None:
        """Return the plan in flight with the next query recorded, and the query; None: there is nothing to request.

        Args:
            time: time of the tick [s].
            target: present target, if certain enough to plan on.
            goal: goal of the mission.
            settings: period and limits of the requests.
            start: earliest start of a new plan [s].
            latency: time from the request to the use of a plan [s].
        """
        if target is None or target.time <= self.requested_target.time or self.plan.end - start <= settings.replan_until:
            return None
        if start <= self.plan.start_time or time - self.requested_at < settings.replan_period:
            return None
        zero = np.zeros(3)
        query = PlanQuery(start, zero, zero, 0.0, target, goal, latency, current=self.plan.trajectory, duration=self.plan.end - start)
        return replace(self, requested_target=target, requested_at=time), query
