"""The predictive controller's QP: Riccati recursions, condensing and general solvers against each other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize

from closed_loop.loop import make_loop, perch, predictive
from perch_control.admission import AtEnd
from perch_control.nmpc.condensing import condense, solve_condensed
from perch_control.nmpc.controller import _TERMINAL, _THRUST_RATE_WEIGHT
from perch_control.nmpc.qp import solve, solve_osqp
from perch_control.nmpc.riccati import Workspace, solve_stages
from perch_core.vehicle import load_vehicle



def random_stages(rng, N=6, n=13):
    A = np.eye(n) + 0.1 * rng.normal(size=(N, n, n))
    L = rng.normal(size=(N + 1, n, n))
    return (A, 0.3 * rng.normal(size=(N, n, 4)), 0.1 * rng.normal(size=(N, n)), L @ L.transpose(0, 2, 1),
            rng.normal(size=(N + 1, n)), rng.normal(size=(N, 4)), 0.7, rng.normal(size=n))


def test_condensed_cost_is_the_stage_costs_sum():
    """Against the definition: simulate the linear system for a given du and add the stage costs up."""
    rng = np.random.default_rng(0)
    A, B, c, Q, q, r, R, dx0 = random = random_stages(rng)
    N, n = c.shape
    H, h, xi, G = condense(*random)

    def cost(du):
        x, total = dx0, 0.0
        for k in range(N):
            u = du[4 * k:4 * k + 4]
            total += 0.5 * R * u @ u + r[k] @ u
            x = A[k] @ x + B[k] @ u + c[k]
            total += 0.5 * x @ Q[k + 1] @ x + q[k + 1] @ x
        return total

    base = cost(np.zeros(4 * N))
    for _ in range(5):
        du = rng.normal(size=4 * N)
        assert cost(du) - base == pytest.approx(0.5 * du @ H @ du + h @ du, rel=1e-9)
        x = dx0
        for k in range(N):
            x = A[k] @ x + B[k] @ du[4 * k:4 * k + 4] + c[k]
        np.testing.assert_allclose(xi[-1] + G[-1] @ du, x, rtol=1e-9, atol=1e-9)


def both_solutions(law):
    """The law's last QP anew from nothing, by Riccati recursions and by condensing and DAQP: du of both, active inputs and states."""
    N, n, s = len(law.U), law.X.shape[1], law.settings
    stages, dx, du, work = law._stages.stages, np.zeros_like(law.X), np.zeros_like(law.U), Workspace(N, n)
    X, U = law._stages.arguments[:, :n].copy(), law._stages.arguments[:N, n:n + 4].copy()
    weight = _THRUST_RATE_WEIGHT if law.thrust_states else s.thrust
    args = stages, X, U, law._start - X[0], weight, law._target, _TERMINAL, law._low, law._high, law._x_low, law._x_high
    assert solve_stages(*args, law._price, 30, work.arrays, dx, du) > 0
    other_x, other_u = solve_condensed(*args)
    np.testing.assert_allclose(dx[:, :10], other_x[:, :10], atol=1e-5)
    return du, other_u, np.count_nonzero(work.fixed), np.count_nonzero(work.soft)


@pytest.mark.parametrize("thrust_states, slow, off", [(False, False, 1e-9), (True, False, 1e-4), (False, True, 1e-4)])
def test_riccati_and_condensing_solve_the_same_qp(thrust_states, slow, off):
    """Along a perch, where bounds are active. A soft bound is not as stiff for both: DAQP prices it by its own scaling."""
    vehicle = load_vehicle("snapdragon")
    law, active = predictive(replace(vehicle, body_rate_max=2.5) if slow else vehicle, thrust_states), [0, 0]
    loop = make_loop(law=law)
    loop.begin_in_hover()
    loop.plant.floor = -10.0
    loop.follow(perch("surface_90_1.7m").trajectory, AtEnd.CONTACT, id=2)
    for _ in range(40):
        loop.run(0.036)
        du, other, fixed, soft = both_solutions(law)
        if not soft:
            np.testing.assert_allclose(du, other, atol=1e-9)
        np.testing.assert_allclose(du, other, atol=off)
        active[0] += bool(fixed)
        active[1] += bool(soft)
    assert active[0] > 3 if not (thrust_states or slow) else active[1] > 3, active


@pytest.mark.parametrize("with_rows", [False, True])
def test_qp_solvers_agree(with_rows):
    rng = np.random.default_rng(3)
    n = 12
    L = rng.normal(size=(n, n))
    H, h = L @ L.T + np.eye(n), 5 * rng.normal(size=n)
    rows = rng.normal(size=(3, n)) if with_rows else np.zeros((0, n))
    args = H, h, np.full(n, -0.3), np.full(n, 0.4), rows, np.full(len(rows), -0.5), np.full(len(rows), 0.5), np.zeros(len(rows), bool)
    x = solve(*args)
    np.testing.assert_allclose(x, solve_osqp(*args), atol=1e-4)
    bounds = [(-0.3, 0.4)] * n
    constraints = [{"type": "ineq", "fun": lambda y: 0.5 - rows @ y}, {"type": "ineq", "fun": lambda y: 0.5 + rows @ y}] if with_rows else []
    peer = minimize(lambda y: 0.5 * y @ H @ y + h @ y, np.zeros(n), jac=lambda y: H @ y + h, bounds=bounds,
                    constraints=constraints, method="SLSQP", options={"ftol": 1e-12, "maxiter": 500})
    np.testing.assert_allclose(x, peer.x, atol=1e-4)
