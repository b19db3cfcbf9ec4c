"""The paper's own quadratic program: order 14 in every segment, equalities as rows. [M:eq3-8, M:eq17]

Each segment counts its own time from 0 [M:eq17], scaled to [0, 1]; the basis is Bernstein's, as solvers fail on powers
of t (OSQP met the end conditions to 1e-6 in none of 200 problems). x, y and z are stacked, because the impact window
[M:eq14] couples them; yaw separates and is solved in `yaw_profile`.
"""

from __future__ import annotations

from math import comb

import numpy as np

from perch_core import bernstein
from perch_planner.reference_element import DEGREE
from perch_planner.solvers import FEASIBILITY, Solution

_SIZE = DEGREE + 1
_CONTINUITY = 4  # [M:eq7] up to the fourth derivative
_INSET = 1e-8  # of a row of unit length: what OSQP and PIQP leave


def _row(order: int, s: float, duration: float) -> np.ndarray:
    """Row that gives a time derivative at s from the coefficients of a segment, shape (15,). [M:eq6]"""
    differences = bernstein.derivative(np.eye(_SIZE), order)
    return differences @ bernstein.basis(DEGREE - order, s) / duration**order


def cost_matrix(duration: float, order: int) -> np.ndarray:
    """Q_i of one segment and dimension, shape (15, 15). [M:eq5]"""
    n = DEGREE - order
    differences = bernstein.derivative(np.eye(_SIZE), order).T
    mass = np.array([[comb(n, i) * comb(n, k) / comb(2 * n, i + k) / (2 * n + 1) for k in range(n + 1)] for i in range(n + 1)])
    return differences.T @ mass @ differences * duration ** (1 - 2 * order)


class FullProgram:
    """Cost, equalities and inequalities in the coefficients; unknown k of dimension d and segment i is (d f + i) 15 + k.

    Args:
        durations: segment durations [s], shape (f,).
        given: what is given at the knots, bool, shape (f + 1, 4).
        values: its values, shape (f + 1, 4, 3).
        cost_order: 4 snap, 3 jerk.
    """

    def __init__(self, durations: np.ndarray, given: np.ndarray, values: np.ndarray, cost_order: int) -> None:
        self._durations, f = durations, len(durations)
        self._count = f * _SIZE
        cost = np.zeros((self._count, self._count))
        for i, duration in enumerate(durations):
            block = slice(i * _SIZE, (i + 1) * _SIZE)
            cost[block, block] = cost_matrix(duration, cost_order)
        self._cost = np.kron(np.eye(3), cost / np.abs(cost).max())
        rows, right = [], []

        def give(segment: int, s: float, order: int, value: np.ndarray) -> None:
            rows.append(self._place(segment, s, order))
            right.append(value)

        for knot in range(f + 1):
            for order in range(4):
                if given[knot, order]:
                    if knot < f:
                        give(knot, 0.0, order, values[knot, order])
                    if knot > 0:
                        give(knot - 1, 1.0, order, values[knot, order])
        for knot in range(1, f):
            for order in range(_CONTINUITY + 1):
                if order > 3 or not given[knot, order]:
                    rows.append(self._place(knot - 1, 1.0, order) - self._place(knot, 0.0, order))
                    right.append(np.zeros(3))
        equalities, right = np.array(rows), np.array(right)
        norms = np.linalg.norm(equalities, axis=1, keepdims=True)
        self._equalities = np.kron(np.eye(3), equalities / norms)
        self._right = (right / norms).T.ravel()
        self._bounds: list[tuple[np.ndarray, float, float]] = []  # rows, lower, upper
        self._local: list[tuple[np.ndarray, float, float]] = []

    def _place(self, segment: int, s: float, order: int) -> np.ndarray:
        row = np.zeros(self._count)
        row[segment * _SIZE:(segment + 1) * _SIZE] = _row(order, s, self._durations[segment])
        return row

    def bound(self, bounds) -> None:
        """Add `lower <= sum of direction . derivative <= upper`, scaled to unit length; fields as in `Bounds`."""
        self._bounds += self._scaled(*bounds)

    def replace(self, bounds) -> None:
        """Set the bounds near the present plan; fields as in `Bounds`."""
        self._local = self._scaled(*bounds)

    def _scaled(self, owner, segments, places, orders, direction, lower, upper) -> list[tuple[np.ndarray, float, float]]:
        rows = np.zeros((len(lower), 3 * self._count))
        for q, r in enumerate(owner):
            rows[r] += np.kron(direction[q], self._place(segments[q], float(places[q]), int(orders[q])))
        norms = np.linalg.norm(rows, axis=1)
        return list(zip(rows / norms[:, None], lower / norms + _INSET, upper / norms - _INSET))

    def solve(self, solver: str) -> tuple[np.ndarray, Solution]:
        """Coefficients, shape (f, 3, 15), and the answer; solved only where every row holds to 1e-6."""
        bounds, least, most = zip(*self._bounds, *self._local)
        rows = np.vstack([self._equalities, np.array(bounds)])
        lower = np.concatenate([self._right, least])
        upper = np.concatenate([self._right, most])
        x, status = _SOLVERS[solver](self._cost, rows, lower, upper, len(self._right))
        if x is None or not np.isfinite(x).all():
            return np.zeros((len(self._durations), 3, _SIZE)), Solution(np.zeros(3 * self._count), False, np.inf, status)
        # First-order and interior-point solvers leave 1e-9 in the equalities, which is 1e-3 m/s^3 in a jerk: that is taken out.
        x = x - np.linalg.lstsq(self._equalities, self._equalities @ x - self._right)[0]
        value = rows @ x
        residual = float(max((lower - value).max(), (value - upper).max()))
        coefficients = x.reshape(3, len(self._durations), _SIZE).transpose(1, 0, 2).copy()
        return coefficients, Solution(x, "solved" in status.lower() and residual <= FEASIBILITY, residual, status)


def _daqp(cost, rows, lower, upper, equalities):
    import daqp

    sense = np.zeros(len(lower), np.int32)
    sense[:equalities] = 5  # active and immutable: an equality
    # The Hessian of [M:eq5] is singular: the proximal method of DAQP needs a weight.
    x, _, flag, _ = daqp.solve(cost, np.zeros(len(cost)), rows, upper, lower, sense, primal_tol=1e-9, eps_prox=1e-6)
    return np.asarray(x), "solved" if flag == 1 else f"exit flag {flag}"


def _osqp(cost, rows, lower, upper, equalities):
    import osqp
    from scipy import sparse

    problem = osqp.OSQP()
    problem.setup(sparse.triu(sparse.csc_matrix(cost), format="csc"), np.zeros(len(cost)), sparse.csc_matrix(rows), lower,
                  upper, verbose=False, eps_abs=1e-9, eps_rel=1e-9, max_iter=50000, polishing=True)
    result = problem.solve(raise_error=False)
    return np.asarray(result.x, float), str(result.info.status)


def _piqp(cost, rows, lower, upper, equalities):
    import piqp

    problem = piqp.DenseSolver()
    problem.settings.eps_abs = problem.settings.eps_rel = 1e-9
    problem.setup(cost, np.zeros(len(cost)), rows[:equalities], lower[:equalities], rows[equalities:],
                  lower[equalities:], upper[equalities:], None, None)
    status = problem.solve()
    return np.asarray(problem.result.x, float), str(status)


_SOLVERS = {"daqp": _daqp, "osqp": _osqp, "piqp": _piqp}
