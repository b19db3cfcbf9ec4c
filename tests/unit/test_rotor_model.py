"""The 17-state model against the rigid-body module, a fine integration and conservation laws. [tests M:eq1, P:eq1]"""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from perch_core import rotor_model, so3
from perch_core.components import components, stack
from perch_core.rotor_model import RotorModel, derivative, hover_state, rk4

MODEL = RotorModel(0.8, (0.003, 0.004, 0.005),
                   ((0.1, 0.1, -0.1, -0.1), (-0.1, 0.1, 0.1, -0.1), (0.016, -0.016, 0.016, -0.016)), 9.81)


def random_state(rng: np.random.Generator) -> np.ndarray:
    return np.concatenate([rng.normal(size=3), so3.quat_exp(rng.normal(size=3)), rng.normal(size=6), rng.uniform(0, 6, 4)])


@pytest.mark.parametrize("seed", range(5))
def test_derivative_agrees_with_newton_and_euler(seed: int) -> None:
    rng = np.random.default_rng(seed)
    x, u = random_state(rng), rng.normal(size=4) * 10
    rate = stack(derivative(MODEL, components(x), components(u)))
    R, w, J = so3.quat_to_matrix(x[3:7]), x[10:13], np.diag(MODEL.inertia)
    torque = np.array(MODEL.torque) @ x[13:]
    np.testing.assert_allclose(rate[:3], x[7:10])
    np.testing.assert_allclose(rate[7:10], R @ [0, 0, x[13:].sum()] / 0.8 - [0, 0, 9.81], atol=1e-12)
    np.testing.assert_allclose(rate[10:13], np.linalg.solve(J, torque - np.cross(w, J @ w)), atol=1e-9)
    np.testing.assert_allclose(rate[13:], u)
    # The attitude moves as R exp(w dt): compare with a finite difference on SO(3).
    dt = 1e-6
    moved = so3.quat_to_matrix(x[3:7] + dt * rate[3:7])
    np.testing.assert_allclose(R.T @ moved, so3.exp(w * dt), atol=1e-9)


def test_rk4_converges_with_the_fourth_order() -> None:
    rng = np.random.default_rng(3)
    x, u, span = random_state(rng), rng.normal(size=4) * 5, 0.2
    truth = solve_ivp(lambda _, y: stack(derivative(MODEL, components(y), components(u))), (0, span), x,
                      rtol=1e-12, atol=1e-12).y[:, -1]

    def error(steps: int) -> float:
        y = components(x)
        for _ in range(steps):
            y = rk4(MODEL, y, components(u), span / steps)
        return float(np.linalg.norm(stack(y) - truth))

    assert error(20) < 1e-4
    assert 12 < error(20) / error(40) < 20


def test_symbols_and_arrays_give_the_same_step() -> None:
    rng = np.random.default_rng(4)
    batch, u = np.array([random_state(rng) for _ in range(6)]), rng.normal(size=(6, 4))
    x_, u_ = ca.SX.sym("x", 17), ca.SX.sym("u", 4)
    symbolic = ca.Function("step", [x_, u_], [ca.vertcat(*rk4(MODEL, components(x_), components(u_), 0.03))])
    numeric = stack(rk4(MODEL, components(batch), components(u), 0.03))
    np.testing.assert_allclose(np.array(symbolic(batch.T, u.T)).T, numeric, atol=1e-12)


def test_hover_is_an_equilibrium_and_free_rotation_keeps_momentum() -> None:
    x = hover_state(MODEL, np.array([1.0, 2, 3]), np.array([0, 0, 0.6, 0.8]))
    np.testing.assert_allclose(stack(derivative(MODEL, components(x), (0.0,) * 4)), 0, atol=1e-12)
    y = x.copy()
    y[10:13], y[13:] = [3.0, -2.0, 1.0], 0.0
    J = np.diag(MODEL.inertia)
    L0 = so3.quat_to_matrix(y[3:7]) @ J @ y[10:13]
    z = components(y)
    for _ in range(500):
        z = rk4(MODEL, z, (0.0,) * 4, 0.002)
    z = stack(z)
    np.testing.assert_allclose(so3.quat_to_matrix(z[3:7] / np.linalg.norm(z[3:7])) @ J @ z[10:13], L0, atol=1e-8)
    np.testing.assert_allclose(z[9], -9.81, rtol=1e-9)


def test_accelerations_of_a_trajectory_are_its_velocity_slopes() -> None:
    rng = np.random.default_rng(5)
    x, u, dt = random_state(rng), rng.normal(size=4), 1e-4
    states = [x]
    for _ in range(2):
        states.append(stack(rk4(MODEL, components(states[-1]), components(u), dt)))
    states = np.array(states)
    a_W, dw_B = rotor_model.accelerations(MODEL, states)
    np.testing.assert_allclose(a_W[1], (states[2, 7:10] - states[0, 7:10]) / (2 * dt), atol=1e-5)
    np.testing.assert_allclose(dw_B[1], (states[2, 10:13] - states[0, 10:13]) / (2 * dt), atol=1e-3)
