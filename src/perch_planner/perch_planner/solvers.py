"""Solvers of quadratic programs in whitened form behind one interface; the residual of every solution is checked.

Every solver minimises |w|^2 under `lower <= rows @ w <= upper`. DAQP is the default: an active-set method that is
exact and the fastest here (0.06-0.13 ms against 2-4 ms for OSQP at the same accuracy). On unscaled rows it can report
"solved" although rows are violated, hence the check.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from perch_core.arrays import Array
from perch_core.jit import compiled

FEASIBILITY = 1e-6
"""Largest violation of a row of unit length that counts as solved."""
_TOLERANCE = 1e-9  # of a row, for DAQP
_NORM_MAX = _TOLERANCE / np.finfo(float).eps  # |w| for which the rounding of a row exceeds it


class Solution(NamedTuple):
    """Result of a solver.

    Attributes:
        w: minimiser, shape (n,); meaningless unless `solved`.
        solved: the residual was checked and is within `FEASIBILITY`.
        residual: largest violation of a row.
        status: status text of the solver.
        dual: multipliers of the rows, shape (r,), a warm start for the next program; None: the solver provides none.
    """

    w: Array
    solved: bool
    residual: float
    status: str
    dual: Array | None = None


@compiled
def _residual(rows: Array, lower: Array, upper: Array, w: Array) -> float:
    """Largest violation of a row; infinite where the solution is not finite."""
    value = rows @ w
    worst = 0.0
    for k in range(len(value)):
        excess = max(lower[k] - value[k], value[k] - upper[k])
        if not np.isfinite(value[k]):
            return np.inf
        worst = max(worst, excess)
    return worst


@compiled
def _contains_zero(lower: Array, upper: Array) -> bool:
    for k in range(len(lower)):
        if lower[k] > 0.0 or upper[k] < 0.0:
            return False
    return True


def _daqp(rows: Array, lower: Array, upper: Array, dual: Array | None) -> tuple[Array, str, Array]:
    import daqp

    # Without a cost matrix and vector DAQP takes the unit matrix and zero.
    # Its dual objective bounds |w|^2 / 2 from below, and grows without end where no w exists: half of the iterations are saved.
    w, _, flag, found = daqp.solve(None, None, rows, upper, lower, np.zeros(len(lower), np.int32), dual_start=dual,
                                   primal_tol=_TOLERANCE, fval_bound=0.5 * _NORM_MAX**2)
    return np.asarray(w), "solved" if flag == 1 else f"exit flag {flag}", np.asarray(found["lam"])


_ITERATIONS_MAX = 20000  # of OSQP for one tolerance
_COARSE, _FINE = (1e-3, 1e-4, 1e-5, 1e-6), 1e-8  # tolerances of OSQP, one after the other


def _osqp(rows: Array, lower: Array, upper: Array, _: Array | None) -> tuple[Array, str, None]:
    import osqp
    from scipy import sparse

    n = rows.shape[1]
    solver = osqp.OSQP()
    solver.setup(sparse.identity(n, format="csc"), np.zeros(n), sparse.csc_matrix(rows), lower, upper, verbose=False,
                 eps_abs=_FINE, eps_rel=_FINE, eps_prim_inf=1e-6, max_iter=_ITERATIONS_MAX, polishing=True, scaling=0)
    for tolerance in (*_COARSE, _FINE):
        # Which rows are active shows long before the last digits, and polishing finds these from the rows.
        solver.update_settings(eps_abs=tolerance, eps_rel=tolerance)
        result = solver.solve(raise_error=False)
        polished = result.info.status_polish == 1 and max(result.info.prim_res, result.info.dual_res) < _FINE
        if polished or "infeasible" in result.info.status or result.info.iter >= _ITERATIONS_MAX:  # finer tolerances take more
            break
    return np.asarray(result.x, float), str(result.info.status), None


SOLVERS: dict[str, Callable[[Array, Array, Array, Array | None], tuple[Array, str, Array | None]]] = {"daqp": _daqp, "osqp": _osqp}


def least_norm(rows: Array, lower: Array, upper: Array, solver: str = "daqp", dual: Array | None = None) -> Solution:
    """Return the shortest w with `lower <= rows @ w <= upper`. [defines M:eq8, in whitened coordinates]

    Args:
        rows: rows of unit length, shape (r, n).
        lower, upper: bounds, infinite where there is none, shape (r,).
        solver: `daqp` or `osqp`.
        dual: warm start of DAQP, the multipliers of a similar program; None: start without active rows.
    """
    if _contains_zero(lower, upper):
        return Solution(np.zeros(rows.shape[1]), True, 0.0, "unconstrained optimum")
    w, status, found = SOLVERS[solver](rows, lower, upper, dual)
    residual = _residual(rows, lower, upper, w) if w.shape == rows.shape[1:] else np.inf
    if residual == np.inf:
        return Solution(np.zeros(rows.shape[1]), False, np.inf, status)
    # A solver that reports "infeasible" is not overruled by a residual; one that reports "solved" is.
    return Solution(w, status.lower() == "solved" and residual <= FEASIBILITY, residual, status, found)
