"""Stage functions and the problem's derivatives against CasADi's own, the cache, and the interpreted path."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from perch_core import lines, so3
from perch_core.lines import Segment
from perch_core.rotor_model import RotorModel, hover_state
from perch_core.vehicle import load_vehicle
from perch_planner.powerline import compiled, nlp, solving
from perch_planner.powerline.formulation import Weights
from perch_planner.powerline.stage_functions import StageModel, line_parameters, stage_functions

VEHICLE = load_vehicle("rpg")
STAGE = StageModel.of(RotorModel.of(VEHICLE), VEHICLE.thrust_rate_max, VEHICLE.body_radii, VEHICLE.mounts["front"])
STAGES = stage_functions(STAGE)
LINE = Segment([3.0, 0.2, 4.0], [0.1, 1.0, 0.05], 2.0, 0.03)


def state(p: list[float], q: np.ndarray = np.array([0.0, 0, 0, 1]), w: list[float] = (0.0, 0, 0)) -> np.ndarray:
    return np.concatenate([p, q, np.zeros(3), w, np.full(4, 1.9), [2.0]])


@pytest.mark.parametrize("solver", ["fatrop", "ipopt"])
@pytest.mark.parametrize("perception, end", [(False, ""), (True, "perched"), (False, "hovering")])
def test_assembled_derivatives_are_those_of_the_chain_rule(solver: str, perception: bool, end: str) -> None:
    problem = nlp.Problem(nlp.Structure(4, 2, perception, end, solver), STAGES)
    f, g, jac, hess = (problem._solver.get_function(name) for name in ("nlp_f", "nlp_g", "nlp_jac_g", "nlp_hess_l"))
    x, p, lam_f, lam_g = (ca.SX.sym(name, size) for name, size in
                          (("x", f.size1_in(0)), ("p", f.size1_in(1)), ("f", 1), ("g", g.size1_out(0))))
    lagrangian = lam_f * f.expand()(x, p) + ca.dot(lam_g, g.expand()(x, p))
    truth = ca.Function("truth", [x, p, lam_f, lam_g], [ca.jacobian(g.expand()(x, p), x), ca.gradient(lagrangian, x),
                                                        ca.densify(ca.hessian(lagrangian, x)[0])])
    rng = np.random.default_rng(0)
    values = [rng.normal(size=x.shape[0]), rng.normal(size=p.shape[0]), 1.7, rng.normal(size=lam_g.shape[0])]
    J, gradient, H = (np.array(ca.densify(part)) for part in truth(*values))
    np.testing.assert_allclose(np.array(ca.densify(jac(*values[:2])[1])), J, rtol=1e-9, atol=1e-9 * np.abs(J).max())
    got = hess(*values)
    if solver == "fatrop":
        np.testing.assert_allclose(np.array(got[0]), gradient, rtol=1e-9, atol=1e-9 * np.abs(gradient).max())
        np.testing.assert_allclose(np.array(ca.densify(got[1])), H, rtol=1e-9, atol=1e-12 * np.abs(H).max())
    else:
        np.testing.assert_allclose(np.array(ca.densify(got)), np.triu(H), rtol=1e-9, atol=1e-12 * np.abs(H).max())


def test_the_hessian_of_a_step_takes_a_dozen_times_the_operations_of_its_gradient_and_no_more() -> None:
    """One directional derivative for each of the 22 variables, of which only the upper triangle is computed. [tests P:eq14]"""
    x, u, lam = ca.SX.sym("x", 18), ca.SX.sym("u", 4), ca.SX.sym("lam", 18)
    gradient, = ca.cse([ca.gradient(ca.dot(lam, STAGES.functions["step"](x, u, 0.1)), ca.vertcat(x, u))])
    assert STAGES.functions["step_hess"].n_instructions() < 12 * ca.Function("gradient", [x, u, lam], [gradient]).n_instructions()


def test_clearance_constraint_is_the_scaled_distance() -> None:
    rng = np.random.default_rng(1)
    for _ in range(30):
        x = state(LINE.centre + rng.normal(0, 0.4, 3), so3.quat_exp(rng.normal(size=3)))
        d = 1 + lines.scaled_clearance(x[None, :3], x[None, 3:7], LINE, VEHICLE.body_radii)[0]
        value = float(STAGES.functions["clearance"](x, line_parameters(LINE)))
        assert value == pytest.approx((d * d - 1) / (d * d + 1), abs=1e-6)


def test_perception_cost_grows_as_the_camera_turns_away_even_past_the_line() -> None:
    """[P:eq13] with the authors' arctan is flat where the camera looks along the line; a solver would never turn."""
    line, weights = line_parameters(Segment([4.0, 0, 4.0], [0, 1, 0], 2.0, 0.03)), [0.0, 0.0, 1.0]
    yaws = np.radians([0, 10, 60, 80, 89, 100, 130, 170])
    costs = [float(STAGES.functions["perception"](state([0, 0, 4.0], so3.quat_exp([0, 0, yaw])), line, weights)) for yaw in yaws]
    assert costs[0] == costs[1] == 0.0  # the centred point is on the segment: its inner half subtends 14 deg to either side
    assert np.all(np.diff(costs[1:]) > 0.05)


@pytest.mark.parametrize("direction", [[0, 1, 0], [0.6, 0.8, 0]])
def test_a_start_with_its_camera_exactly_below_a_line_has_a_cost_with_derivatives(direction: list[float]) -> None:
    """[P:eq9] has a pole there; with NaN at the first node fatrop does not return."""
    x, line = state([4.0, 0, 3.0]), line_parameters(Segment([4.0, 0, 4.2], direction, 2.0, 0.03))
    x[3:7] = so3.quat_exp([0, 0, np.arctan2(-direction[0], direction[1])])
    for name, multiplier in (("perception", []), ("perception_jac", []), ("perception_hess", [1.0]), ("perception_gauss_newton", [1.0])):
        assert np.isfinite(np.array(STAGES.functions[name](x, line, [50.0, 100.0, 100.0], *multiplier))).all(), name


def test_gauss_newton_has_the_gradient_and_never_bends_down() -> None:
    rng, line, weights = np.random.default_rng(4), line_parameters(LINE), [50.0, 100.0, 100.0]
    sparsity = STAGES.hessian["perception"]

    def second(name: str, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        values = np.array(STAGES.functions[name](x, line, weights, 1.0)).ravel()
        upper = np.array(ca.densify(ca.DM(sparsity, values[18:])))
        return values[:18], np.linalg.eigvalsh(upper + upper.T - np.diag(np.diag(upper)))

    least = []
    for _ in range(30):
        x = state(LINE.centre + rng.normal(0, 2.0, 3), so3.quat_exp(rng.normal(size=3)))
        (exact, curvature), (gradient, never) = second("perception_hess", x), second("perception_gauss_newton", x)
        np.testing.assert_allclose(gradient, exact, rtol=1e-9, atol=1e-9 * np.abs(exact).max())
        assert never.min() > -1e-9 * never.max()
        least.append(curvature.min() / np.abs(curvature).max())
    assert min(least) < -0.1  # the exact one does


@pytest.mark.parametrize("N", [30, 45])
def test_running_cost_is_equation_15(N: int) -> None:
    """With N times the paper's impulse, and weights that mean the same for each N as for the authors' 30. [tests P:eq15]"""
    x, u = state([0, 0, 1], w=[1.0, 2, 3]), np.array([0.1, -0.2, 0.3, 0.4])
    T, rates = 2.0, 40.0 * u
    impulse = np.full(4, 1.9) * T / N + rates * T**2 / (2 * N**2)
    weights = solving.run_weights(Weights(thrust=0.02, rate=0.3, rate_between=0.0), 0.0, 40.0, N)
    cost = float(STAGES.functions["run"](x, u, 1 / N, weights))
    assert cost == pytest.approx(30 / N * (0.02 * N**2 * impulse @ impulse + 0.3 * 14))


def test_end_cost_weighs_each_error_against_its_own_reference() -> None:
    """Position, direction of b3, velocity and body rate of equation 15, and the thrust of a hover. [tests P:eq15]"""
    rng = np.random.default_rng(5)
    x, reference = rng.normal(size=18), rng.normal(size=12)
    x[3:7] = so3.quat_exp(rng.normal(size=3))
    b3, hover = so3.quat_to_matrix(x[3:7])[:, 2], VEHICLE.mass * 9.81 / 4
    squares = [np.sum(error**2) for error in (x[:2] - reference[:2], x[2] - reference[2], b3 - reference[3:6], x[7:10] - reference[6:9],
                                              x[10:13] - reference[9:12], x[13:17] - hover)]
    weights = solving.end_weights(Weights(xy_end=2.0, z_end=3.0, tilt_end=5.0, v_end=7.0, w_end=11.0, thrust_end=13.0))
    assert float(STAGES.functions["end"](x, reference, weights)) == pytest.approx(np.dot([2.0, 3.0, 5.0, 7.0, 11.0, 13.0], squares))


@pytest.mark.parametrize("duration, reached", [((2.5, 4.0), 2.5), ((0.1, 0.6), 0.6)])
def test_a_solution_goes_to_the_bounds_of_duration_height_and_thrust_and_no_farther(duration: tuple[float, float], reached: float) -> None:
    """Its goal, 2 m away and below the least height, takes 1.6 s. [tests P:eq14]"""
    N, hover = 10, VEHICLE.mass * 9.81 / 4
    start, goal = hover_state(STAGE.rotor, np.array([0.0, 0, 1.2]), np.array([0.0, 0, 0, 1])), np.array([2.0, 0, 0.5])
    data = nlp.ProblemData(
        start=start, reference=np.array([*goal, 0, 0, 1, *np.zeros(6)]), lines=np.zeros((0, 8)), run_weights=np.array([0.02, 0.3, 0.0, 0.0]),
        end_weights=np.array([3000.0, 3000, 10, 1, 1, 0]), perception_weights=np.zeros((N, 3)), duration=duration, height_min=1.0,
        thrust=(0.7 * hover, 1.2 * hover), body_rate=10.0, end_tolerance=np.zeros(0), clearance=np.zeros(N),
        states=np.tile([*start, sum(duration) / 2], (N + 1, 1)), inputs=np.zeros((N, 4)), defects=np.zeros((N, 18)))
    found = nlp.Problem(nlp.Structure(N, 0, False, solver="ipopt"), STAGES).solve(data)
    assert found.converged and found.duration == pytest.approx(reached, abs=1e-5)
    assert found.states[1:, 2].min() == pytest.approx(1.0, abs=1e-5)
    thrust = found.states[1:, 13:17]
    assert 0.7 * hover - 1e-5 <= thrust.min() and thrust.max() <= 1.2 * hover + 1e-5
    if reached == 0.6:  # in a hurry
        assert (thrust.min(), thrust.max()) == pytest.approx((0.7 * hover, 1.2 * hover), abs=1e-3)


def test_spin_between_the_nodes_sees_a_peak_that_both_nodes_miss() -> None:
    x, u = state([0, 0, 1], w=[0.0, -6.0, 0]), np.array([-1.0, 1, 1, -1]) * 0.9
    x[13:17] = [3.1, 0.7, 0.7, 3.1]
    step = float(1 / 30)
    after = np.array(STAGES.functions["step"](x, u, step)).ravel()
    middle = float(STAGES.functions["body_rate_between"](x, u, step, 7.0))
    fine = np.array(STAGES.functions["step"](x, u, step / 2)).ravel()
    assert middle == pytest.approx(1 - fine[10:13] @ fine[10:13] / 49, abs=1e-6)
    assert np.abs(after[11] - x[11]) < np.abs(fine[11] - x[11])  # the middle is farther out than the end


def test_defects_make_two_steps_as_exact_as_thirty_two() -> None:
    problem = nlp.Problem(nlp.Structure(4, 0, False, solver="ipopt"), STAGES)
    rng = np.random.default_rng(2)
    states = np.array([state([0, 0, 2], so3.quat_exp(rng.normal(size=3)), rng.normal(0, 3, 3)) for _ in range(5)])
    states[:, 17] = 0.3  # intervals of 75 ms, as in flight
    inputs = rng.uniform(-1, 1, (4, 4))
    step = STAGES.functions["step"]
    for x, u, defect in zip(states, inputs, problem.defects_of(states, inputs)):
        fine = x
        for _ in range(50):
            fine = step(fine, u, 0.25 / 50)
        corrected = np.array(step(x, u, 0.25)).ravel() + defect
        error, before = (np.abs(value - np.array(fine).ravel())[:10].max() for value in (corrected, np.array(step(x, u, 0.25)).ravel()))
        assert error < 1e-3 * before


def test_compiled_functions_give_the_interpreted_values() -> None:
    """Uses the machine's cache: only the first run on a machine compiles."""
    fast, done = compiled.load(STAGES)
    if not done:
        pytest.skip("no C compiler here: the interpreted path is what everybody gets")
    rng = np.random.default_rng(3)
    for name, function in STAGES.functions.items():
        arguments = [rng.random(function.size_in(i)) for i in range(function.n_in())]
        slow, quick = (np.array(f(*arguments)) for f in (function, fast.functions[name]))
        np.testing.assert_allclose(quick, slow, rtol=1e-9, atol=1e-9 * max(1.0, np.abs(slow).max()), err_msg=name)


def test_no_compiler_means_interpreted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PERCH_COMPILE", "0")
    assert compiled.load(STAGES) == (STAGES, False)
