"""Requests, goals and parameters: what was found once stays mended, and some new ones; the long form is `scripts/fuzz.py services`."""

from __future__ import annotations

import random
from pathlib import Path

import numpy as np
import pytest
from perch_core.values import PerchPlan, PerchPlanRequest, seconds
from perch_core.vehicle import load_vehicle
from perch_core.trajectory import rest_to_rest
from fuzzing.messages import Nonsense
from fuzzing.services import ask, good, judge_plan, replay
from fuzzing.spoiled import Way, in_effect, spoilt

CASES = sorted((Path(__file__).parent / "cases" / "services").glob("*.json"))


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.stem)
def test_what_was_found_stays_mended(case):
    replay(case.read_text())


@pytest.mark.parametrize("task, count", [("goal", 5), ("depart", 1), ("set_controller", 3), ("abort", 1), ("parameters", 6)])
def test_every_request_is_answered_in_sense(task, count):
    rng = random.Random(task)
    assert {ask(None, task, rng.randrange(2**31)) for _ in range(count)} <= {"taken", "refused"}


def test_the_oracle_of_plans_knows_nonsense():
    level = np.array([0.0, 0.0, 0.0, 1.0])
    request = PerchPlanRequest(start=0, p=np.zeros(3), p_WS=np.array([1.0, 0.0, 0.0]), q_WS=level)
    for end in ((9.0, 0.0, 0.1), (1.0, 0.0, -0.3)):
        plan = PerchPlan(success=True, trajectory=rest_to_rest(np.zeros(3), np.array(end), 0.0, 0.0, 8.0))
        with pytest.raises(Nonsense, match="contact|surface"):
            judge_plan("plan_perch", request, plan, load_vehicle("snapdragon"))
    with pytest.raises(Nonsense, match="no typed refusal"):
        judge_plan("plan_perch", request, PerchPlan(success=False, message="planning failed: ValueError: x"), load_vehicle("snapdragon"))


@pytest.mark.parametrize("late", [0, 1])
def test_a_plan_begins_when_it_was_asked_to_whatever_the_clock_says(late):
    """In 2026 a clock says 1.8e9 s."""
    level, start = np.array([0.0, 0.0, 0.0, 1.0]), 2_147_483_647 * 10**9
    request = PerchPlanRequest(start=start, p=np.zeros(3), p_WS=np.array([1.0, 0.0, 0.0]), q_WS=level)
    plan = PerchPlan(success=True, trajectory=rest_to_rest(np.zeros(3), np.array([1.0, 0.0, 0.0]), 0.0, 0.0, 8.0, start_time=seconds(start) + late))
    if late:
        with pytest.raises(Nonsense, match="starts at"):
            judge_plan("plan_perch", request, plan, load_vehicle("snapdragon"))
    else:
        judge_plan("plan_perch", request, plan, load_vehicle("snapdragon"))


@pytest.mark.parametrize("ways, counts", [
    ([Way(("start_jerk", "y"), "=", 1e308)], True),
    ([Way(("start_jerk", "y"), "=", 1e308), Way(("start_jerk", "y"), "=", 0.1)], False),
    ([Way(("start_jerk", "y"), "=", float("nan")), Way(("start_jerk", "x"), "=", 0.1)], True),
    ([Way(("waypoints",), "count", 30_000)], False),  # there is none to repeat
])
def test_nonsense_that_is_not_in_the_request_any_more_is_not_asked_for(ways, counts):
    assert in_effect(ways[0], good("plan_perch"), spoilt(good("plan_perch"), ways)) == counts
