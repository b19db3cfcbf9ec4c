"""The reduced program against the paper's full one, against scipy, and its building blocks against quadrature."""

from __future__ import annotations

import numpy as np
import pytest
from perch_core import bernstein, jit
from perch_core.flatness import flat_to_state
from perch_core.surface import PerchSurface
from perch_core.vehicle import load_vehicle
from perch_planner import plan_checks, reduced_qp, reference_element, segment_program
from perch_planner.active_set import least_norm
from perch_planner.contact_constraints import Contact, conditions, tube_bounds, tube_times
from perch_planner.cutting import limit_cuts
from perch_planner.linear_bounds import Bounds
from perch_planner.paper import paper_m
from perch_planner.problem import PerchProblem, PerchSettings, StartState, Waypoint
from perch_planner.reduced_rows import rows_of
from perch_planner.yaw_profile import yaw_coefficients

VEHICLE = load_vehicle("snapdragon")


def problem(inclination_deg: float = 60.0, waypoints=()) -> PerchProblem:
    surface = PerchSurface.from_inclination(np.array([2.0, 0.3, 1.5]), np.radians(inclination_deg), 0.2)
    start = StartState((0.0, 0.0, 1.4), v=(0.3, 0.1, 0.0), a=(0.2, 0.0, 0.1), j=(0.5, 0.0, 0.0))
    return PerchProblem(start, surface, tuple(Waypoint(p) for p in waypoints))


THREE = ((0.5, 0.0, 1.4), (1.0, 0.2, 1.5), (1.5, 0.2, 1.5))


def cost(coefficients: np.ndarray, durations: np.ndarray, order: int) -> float:
    """Integral of the squared derivative by Gauss quadrature."""
    nodes, weights = np.polynomial.legendre.leggauss(16)
    total = 0.0
    for segment, duration in zip(coefficients, durations):
        values = bernstein.evaluate(bernstein.derivative(segment, order), 0.5 * (nodes + 1.0)) / duration**order
        total += float((values**2 @ weights).sum()) * 0.5 * duration
    return total


@pytest.mark.parametrize("order", [3, 4])
def test_gram_matrices_are_the_integrals(order):
    """[tests M:eq5]"""
    nodes, weights = np.polynomial.legendre.leggauss(16)
    rows = bernstein.evaluate(reference_element.TABLES[order, :15 - order].T, 0.5 * (nodes + 1.0))
    assert reference_element.GRAMS[order] == pytest.approx((rows * weights / 2) @ rows.T, rel=1e-9, abs=1e-8)


def test_hermite_functions_are_unit_derivatives_and_bubbles_vanish_at_the_ends():
    for end, place in ((0, 0.0), (1, 1.0)):
        for order in range(4):
            values = bernstein.evaluate(reference_element.TABLES[order, :15 - order].T, place)
            expected = np.zeros(15)
            expected[4 * end + order] = 1.0
            assert values == pytest.approx(expected, abs=1e-9)
    assert reference_element.GRAMS[4][8:, 8:] == pytest.approx(np.eye(7), abs=1e-9)


def program(contact: Contact, durations: np.ndarray, order: int = 4, everywhere: bool = False):
    """The reduced program with the rows of tube and window, what is given at the knots, and its values."""
    given, values, bubbles, bounds = conditions(durations, everywhere, contact.velocity, contact.problem)
    made = reduced_qp.assemble(durations, given, values, bubbles, reference_element.GRAMS[order], order)
    return made, rows_of(made, bounds), given, values


def solved(made, rows) -> np.ndarray:
    solution = least_norm(*rows)
    assert solution.solved
    return reduced_qp.coefficients(made, solution.w)


@pytest.mark.parametrize("objective, order", [("snap", 4), ("jerk", 3)])
@pytest.mark.parametrize("waypoints, durations", [((), (1.6,)), (THREE, (0.7, 0.5, 0.5, 0.7))])
def test_reduced_and_full_form_agree(objective, order, waypoints, durations):
    """The program that flies has the optimum of the paper's. [tests M:eq4-8, M:eq11, M:eq14]"""
    asked, durations = problem(60.0, waypoints), np.array(durations)
    settings = PerchSettings(objective=objective, tangential_speed_max=20.0, contact_delay=0.0)  # of which the paper knows nothing
    contact = Contact(asked, settings, VEHICLE.perch_offset)
    same, default = (solved(*program(contact, durations, order, everywhere)[:2]) for everywhere in (True, False))
    chosen = paper_m.position_program(asked, settings, VEHICLE, durations)
    full = chosen.coefficients(least_norm(chosen.rows, chosen.lower, chosen.upper).w)
    assert same == pytest.approx(full, abs=1e-4)
    assert cost(same, durations, order) == pytest.approx(cost(full, durations, order), rel=1e-6)
    # Without the bubbles before the tube the fourth derivative is continuous at a small price.
    if order == 4:
        assert 1.0 - 1e-6 <= cost(default, durations, order) / cost(full, durations, order) <= 1.001


def test_two_libraries_find_the_same_minimum():
    import daqp
    import osqp
    from scipy import sparse

    made, rows, _, _ = program(Contact(problem(80.0), PerchSettings(), VEHICLE.perch_offset), np.array([1.2, 0.5]))
    matrix, lower, upper = rows
    peer, n = osqp.OSQP(), matrix.shape[1]
    peer.setup(sparse.identity(n, format="csc"), np.zeros(n), sparse.csc_matrix(matrix), lower, upper, verbose=False, eps_abs=1e-8, eps_rel=1e-8,
               max_iter=20000, polishing=True, scaling=0)
    own = solved(made, rows)
    assert own == pytest.approx(reduced_qp.coefficients(made, np.asarray(peer.solve(raise_error=True).x)), abs=1e-5)
    assert own == pytest.approx(reduced_qp.coefficients(made, daqp.solve(None, None, *rows[:1], upper, lower, np.zeros(len(lower), np.int32))[0]), abs=1e-9)


def test_a_program_that_starts_at_the_multipliers_of_another_has_the_same_minimum():
    """Also where these are of rows that do not matter any more, and where the program has no solution."""
    rng, solvable = np.random.default_rng(1), 0
    for _ in range(50):
        rows = rng.normal(size=(30, 12))
        rows /= np.linalg.norm(rows, axis=1)[:, None]
        lower = rng.uniform(-1.0, 0.4, 30)
        cold = least_norm(rows, lower, lower + 1.5)
        warm = least_norm(rows, lower, lower + 1.5, dual=rng.normal(size=30) * (rng.random(30) < 0.3))
        assert warm.solved == cold.solved
        if cold.solved:
            assert np.abs(warm.w - cold.w).max() < 1e-9
            again = least_norm(rows, lower, lower + 1.5, dual=cold.dual)
            assert np.array_equal(np.sign(again.dual), np.sign(cold.dual)) and cold.dual.any()
            solvable += 1
    assert 20 < solvable < 50, "both kinds are met"


def test_the_steps_of_a_program_allocate_no_arrays():
    """An array for each step takes more time than its arithmetic: arrays are allocated for each look at all rows, of which there are few."""
    if not jit.COMPILED:
        pytest.skip("without numba there is no count of allocations")
    from numba.core.runtime import _nrt_python, rtsys

    rng = np.random.default_rng(0)
    rows = rng.normal(size=(120, 60))
    rows /= np.linalg.norm(rows, axis=1)[:, None]
    values = rows @ rng.normal(size=60)
    lower, upper = values - 0.01, values + 0.01 + np.arange(120) % 3
    least_norm(rows, lower, upper)
    _nrt_python.memsys_enable_stats()
    try:
        begin = rtsys.get_allocation_stats().alloc
        answer = least_norm(rows, lower, upper)
        allocated = rtsys.get_allocation_stats().alloc - begin
    finally:
        _nrt_python.memsys_disable_stats()
    assert answer.solved and np.count_nonzero(answer.dual) > 50, "many steps are taken"
    assert 0 < allocated < 200


def test_multipliers_follow_the_keys_of_their_rows():
    carried = segment_program._transfer_multipliers(np.array([2, 5, 7]), np.array([1.0, -2.0, 3.0]), np.array([1, 5, 6, 7, 9]))
    assert carried.tolist() == [0.0, -2.0, 0.0, 3.0, 0.0]


def test_least_norm_is_the_minimum_that_scipy_finds():
    from scipy.optimize import minimize

    rng = np.random.default_rng(4)
    rows = rng.normal(size=(6, 8))
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    lower, upper = np.full(6, 0.1), np.full(6, 0.4)
    answer = least_norm(rows, lower, upper)
    peer = minimize(lambda w: w @ w, np.ones(8), jac=lambda w: 2 * w, method="SLSQP", options={"ftol": 1e-14}, constraints=[
        {"type": "ineq", "fun": lambda w: rows @ w - lower}, {"type": "ineq", "fun": lambda w: upper - rows @ w}])
    assert answer.solved and answer.w @ answer.w == pytest.approx(peer.fun, rel=1e-6)


def test_contradictory_bounds_are_not_called_solved():
    rows = np.array([[1.0, 0.0], [-1.0, 0.0]])
    answer = least_norm(rows, np.array([1.0, 1.0]), np.array([2.0, 2.0]))
    assert not answer.solved


@pytest.mark.parametrize("at, bad", [(0, np.nan), (0, np.inf), (0, -np.inf), (1, np.nan), (1, np.inf), (2, np.nan), (2, -np.inf)])
def test_rows_and_bounds_that_no_vector_keeps_end_unsolved(at, bad):
    rows, lower, upper = np.array([[0.6, 0.8], [0.8, -0.6]]), np.array([0.5, 0.3]), np.array([1.0, 1.0])
    (rows[:, 0], lower, upper)[at][1] = bad
    assert not least_norm(rows, lower, upper).solved


def test_end_conditions_and_continuity_are_exact():
    """[tests M:eq6, M:eq7]"""
    durations = np.array([0.7, 0.5, 0.5, 0.7])
    made, rows, given, values = program(Contact(problem(90.0, THREE), PerchSettings(), VEHICLE.perch_offset), durations)
    coefficients = solved(made, rows)
    for knot in range(5):
        for order in range(5):
            sides = []
            if knot < 4:
                sides.append(bernstein.evaluate(bernstein.derivative(coefficients[knot], order), 0.0) / durations[knot]**order)
            if knot > 0:
                sides.append(bernstein.evaluate(bernstein.derivative(coefficients[knot - 1], order), 1.0) / durations[knot - 1]**order)
            if order < 4 and given[knot, order]:
                for side in sides:
                    assert side == pytest.approx(values[knot, order], abs=1e-9)
            if len(sides) == 2:
                assert sides[0] == pytest.approx(sides[1], rel=1e-8, abs=1e-7)


def test_waypoint_derivatives_are_met_even_where_all_are_given():
    points = (Waypoint(THREE[0], v=(1.0, 0.0, 0.0)), Waypoint(THREE[1], v=(1.0, 0.2, 0.0), a=(0.0, 0.0, 0.0), j=(0.0, 0.0, 0.0)))
    asked = PerchProblem(problem().start, problem().surface, points)
    contact = Contact(asked, PerchSettings(), VEHICLE.perch_offset)
    durations = np.array([0.7, 0.6, 0.9])
    coefficients = solved(*program(contact, durations)[:2])
    for k, waypoint in enumerate(points):
        for order, value in enumerate((waypoint.p, waypoint.v, waypoint.a, waypoint.j)):
            if value is not None:
                reached = bernstein.evaluate(bernstein.derivative(coefficients[k], order), 1.0) / durations[k]**order
                assert reached == pytest.approx(value, abs=1e-9)
    snaps = [bernstein.evaluate(bernstein.derivative(coefficients[k], 4), s) / durations[k]**4 for k, s in ((1, 1.0), (2, 0.0))]
    assert snaps[0] == pytest.approx(snaps[1], rel=1e-7, abs=1e-6)


def test_cuts_hold_where_they_are_set_also_as_sums_of_derivatives():
    durations = np.array([1.2, 0.5])
    made, rows, _, _ = program(Contact(problem(60.0), PerchSettings(), VEHICLE.perch_offset), durations)

    def at(coefficients):
        return [bernstein.evaluate(bernstein.derivative(coefficients[0], k), 0.4)[0] / durations[0]**k for k in (3, 2)]

    jerk, force = at(solved(made, rows))
    x, bound = np.array([1.0, 0.0, 0.0]), jerk - 2.0 * force - 1.0
    cut = Bounds(np.array([0, 0]), np.array([0, 0]), np.array([0.4, 0.4]), np.array([3, 2]), np.array([x, -2.0 * x]),
                 np.array([-np.inf]), np.array([bound]))
    jerk, force = at(solved(made, tuple(map(np.concatenate, zip(rows, rows_of(made, tuple(cut)))))))
    assert jerk - 2.0 * force <= bound + 1e-5


def test_tube_bounds_are_sorted_and_leave_room_on_every_axis():
    """[tests M:eq15]"""
    surface = PerchSurface.from_inclination(np.zeros(3), np.pi / 2)
    end = 3.3 * surface.normal - (0.0, 0.0, 9.81)
    lower, upper = tube_bounds(end, 0.1, 0.33)
    # At 90 degrees the paper's inequality reads -8.829 <= z <= -10.791, which nothing satisfies, and y = 0.
    assert (lower[2], upper[2]) == pytest.approx((-10.791, -8.829))
    assert (lower[1], upper[1]) == pytest.approx((-0.33, 0.33), abs=1e-9)
    assert (lower < end).all() and (end < upper).all()
    times = tube_times(0.15, 0.01)
    assert len(times) == 15 and times[0] == pytest.approx(-0.15) and times[-1] == pytest.approx(-0.01)


def test_full_cost_is_the_papers_integral():
    rng = np.random.default_rng(1)
    segment = rng.normal(size=15)
    expected = cost(np.array([[segment, 0 * segment, 0 * segment]]), np.array([0.7]), 4)
    assert segment @ paper_m.cost_matrix(0.7, 4) @ segment == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("order, degree", [(4, 7), (3, 5)])
def test_yaw_meets_both_ends_smoothly_by_the_shorter_turn(order, degree):
    durations = np.array([0.6, 0.3, 0.5])
    rows = yaw_coefficients(3.0, 0.4, -0.2, -3.0, durations, order)
    assert np.abs(np.diff(rows, n=degree + 1, axis=1)).max() < 1e-9
    first = [bernstein.evaluate(bernstein.derivative(rows[0], k), 0.0) / 0.6**k for k in range(3)]
    last = [bernstein.evaluate(bernstein.derivative(rows[2], k), 1.0) / 0.5**k for k in range(3)]
    assert first == pytest.approx([3.0, 0.4, -0.2], abs=1e-9)
    assert last == pytest.approx([2 * np.pi - 3.0, 0.0, 0.0], abs=1e-9)
    for k in range(4):
        left = bernstein.evaluate(bernstein.derivative(rows[0], k), 1.0) / 0.6**k
        assert left == pytest.approx(float(bernstein.evaluate(bernstein.derivative(rows[1], k), 0.0)) / 0.3**k, abs=1e-8)


@pytest.mark.parametrize("seed", range(20))
def test_the_cut_of_a_body_rate_removes_the_plan_also_where_it_spins(seed):
    """Whatever share of the rate is spin: the cut at the limit's place must not hold for the plan that breaks the limit."""
    rng = np.random.default_rng(seed)
    coefficients, yaw, durations = rng.normal(0.0, 0.6, (1, 3, 15)), rng.normal(0.0, 2.0, (1, 15)), np.array([1.2])
    at = [bernstein.evaluate(bernstein.derivative(coefficients[0], k), 0.4) / durations[0]**k for k in range(5)]
    turn = [float(bernstein.evaluate(bernstein.derivative(yaw, k), 0.4)[0]) / durations[0]**k for k in range(3)]
    rate = 0.99 * np.linalg.norm(flat_to_state(*at, *turn, 0.25).w_WB_B)
    where = np.full((5, 2), -1.0)
    where[plan_checks.BODY_RATE] = 0.0, 0.4
    zero = np.zeros(3)
    cut = Bounds(*limit_cuts(where, coefficients, yaw, durations, zero, zero, np.array([0.0, 0.0, 1.0]), 0.0, 9.0, 9.0, rate, 0.1, 0.0, 0.0))
    terms = cut.places == 0.4
    value = sum(d @ at[order] for d, order in zip(cut.direction[terms], cut.orders[terms]))
    assert value > cut.upper[cut.owner[terms][0]]
