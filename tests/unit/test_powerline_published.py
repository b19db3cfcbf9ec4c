"""The problems that paper P's authors published: their durations with their costs, and better ends with our limits. [P:VI]"""

from __future__ import annotations

import numpy as np
import pytest

from perch_planner.powerline import problem
from perch_planner.powerline.visibility import visibility

DEADLINE = 60.0
"""Wall-clock time that suffices on a busy machine, too [s]."""

# Measured on the authors' own trajectories (docs/powerline.md): duration, end position error, tilt error, end speed.
PUBLISHED = {
    "powerline_deg90_published": (1.861, 0.0013, 0.46, 0.038),
    "powerline_upside_down_published": (2.485, 0.0046, 0.66, 0.091),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", PUBLISHED)
def test_published_costs_give_the_published_trajectories(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PERCH_COMPILE", "0")  # a vehicle that nobody flies; and this is the path without a compiler
    duration, _, tilt, speed = PUBLISHED[name]
    planned = problem.plan(problem.load(name), deadline=DEADLINE)
    bounds = {bound.quantity: bound for bound in planned.plan.bounds}
    assert planned.plan.perch.duration == pytest.approx(duration, abs=1e-3)
    # The end errors are part of the published optimum: a soft end leaves them, whoever solves it.
    assert bounds["end_tilt"].maximum == pytest.approx(tilt, abs=0.02)
    assert bounds["end_speed"].maximum == pytest.approx(speed, abs=0.006)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["powerline_deg90", "powerline_upside_down", "powerline_deg90_perception"])
def test_published_starts_within_our_limits(name: str) -> None:
    planned = problem.plan(problem.load(name), deadline=DEADLINE)
    perch, recovery = planned.plan.perch, planned.plan.recovery
    assert all(bound.holds for bound in planned.plan.bounds)
    for part in (perch, recovery):
        assert part.states[:, 13:17].max() <= 7.85
        assert part.states[:, 2].min() >= 0.8
    assert np.linalg.norm(perch.states[-1, :3] - planned.request.perch.p_WB) <= 1e-3
    assert np.linalg.norm(recovery.states[-1, 7:10]) <= 0.02
    np.testing.assert_allclose(perch.states[-1, :13], recovery.states[0, :13], rtol=0.0, atol=1e-15)  # appended without a jump


@pytest.mark.slow
def test_perception_keeps_the_line_in_front() -> None:
    with_it, without = (problem.plan(problem.load("powerline_deg90_perception"), perception=on, with_recovery=False, deadline=DEADLINE)
                        for on in (True, False))
    seen, unseen = (visibility(p.plan.perch.states, p.request.target(), p.vehicle.mounts["front"]).summary()
                    for p in (with_it, without))
    assert seen["cheirality_share"] >= 0.99
    assert seen["segment_share"] > unseen["segment_share"] + 0.4
    assert seen["seen_share"] > unseen["seen_share"] + 0.4
