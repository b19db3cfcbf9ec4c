"""Plans from random starts, judged by rigid-body dynamics of their own. The thousand of the issue: scripts/bench.py powerline."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from oracles import rigid_body
from perch_core import so3
from perch_core.lines import scaled_clearance
from perch_core.rotor_model import P, Q, THRUST, V, W
from perch_core.vehicle import load_vehicle
from perch_planner.powerline import problem
from perch_planner.powerline.plan import Manoeuvre
from perch_planner.powerline.planner import PowerlinePlanner
from perch_planner.powerline.starts import random_start

VEHICLE = load_vehicle("rpg")
CASES = ("line_80", "line_20", "line_180", "line_80_pa", "line_20_pa")
SUB_STEPS = 2  # per sample of the plan, about 1 ms


@pytest.fixture(scope="module")
def planner() -> PowerlinePlanner:
    return PowerlinePlanner(VEHICLE)


def flown_again(part: Manoeuvre) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions, attitudes and velocities under the plan's thrusts, by rotation matrices and the midpoint rule."""
    state = part.states[0]
    p, v, w, R = state[P], state[V], state[W], so3.quat_to_matrix(state[Q])
    h = part.duration / (SUB_STEPS * (len(part.times) - 1))  # the samples fall on the kinks of the thrusts
    middles = h * (np.arange(SUB_STEPS * (len(part.times) - 1)) + 0.5)
    thrust = np.stack([np.interp(middles, part.times, column) for column in part.states[:, THRUST].T], axis=1)
    out = [(p, R, v)]
    for gamma in thrust:
        _, dw = rigid_body.accelerations(VEHICLE, R, w, gamma)
        R_mid, w_mid = R @ so3.exp(h / 2 * w), w + h / 2 * dw
        a, dw = rigid_body.accelerations(VEHICLE, R_mid, w_mid, gamma)
        p, v, w, R = p + h * v + h**2 / 2 * a, v + h * a, w + h * dw, R @ so3.exp(h * w_mid)
        out.append((p, R, v))
    p, R, v = (np.array(column) for column in zip(*out))
    return p, so3.quat_from_matrix(R), v


@pytest.mark.parametrize("seed", [1])
@pytest.mark.parametrize("case", CASES)
def test_random_starts_reach_the_line_and_keep_every_limit(planner: PowerlinePlanner, case: str, seed: int) -> None:
    nominal = problem.load(f"powerline_{case}").request(VEHICLE)
    request = random_start(nominal, problem.load(f"powerline_{case}"), VEHICLE, np.random.default_rng(seed))
    plan = planner.plan(replace(request, deadline=60.0))  # a busy machine plans, too
    assert all(bound.holds for bound in plan.bounds)
    for part in plan.parts:
        p, q, v = flown_again(part)
        clearance = min(scaled_clearance(p, q, line, VEHICLE.body_radii).min() for line in request.lines)
        assert clearance > 0 and p[:, 2].min() > 0.8
        assert 0.03 < part.states[:, THRUST].min() and part.states[:, THRUST].max() <= 7.85
        slopes = np.diff(part.states[:, THRUST], axis=0) / np.diff(part.times)[:, None]
        assert np.abs(slopes).max() <= 40 + 1e-6
        if part is plan.perch:
            assert np.linalg.norm(p[-1] - request.perch.p_WB) < 0.0015
            assert so3.angle_between(so3.quat_to_matrix(q[-1])[:, 2], request.perch.s3_W) < np.radians(0.15)
        assert np.linalg.norm(v[-1]) < 0.025
