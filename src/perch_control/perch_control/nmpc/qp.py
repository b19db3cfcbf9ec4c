"""The dense QP of one iteration: DAQP where it is installed, OSQP elsewhere."""

from __future__ import annotations

import numpy as np

try:
    import daqp
except ImportError:  # about ten times slower, the same solutions to 1e-6
    daqp = None

_SOFT = 8  # DAQP's mark of a constraint that may be violated at a price


class QpFailure(RuntimeError):
    """Raised when the QP has no solution, or the solver has not found it."""


def solve(H: np.ndarray, h: np.ndarray, low: np.ndarray, high: np.ndarray, rows: np.ndarray, row_low: np.ndarray,
          row_high: np.ndarray, soft: np.ndarray) -> np.ndarray:
    """Minimise `x' H x / 2 + h' x` within a box and rows.

    Args:
        H, h: cost, shapes (n, n), (n,).
        low, high: box, shape (n,).
        rows, row_low, row_high: general constraints, shapes (m, n), (m,), (m,).
        soft: which rows may be violated at a price, shape (m,) of bool.

    Returns:
        x, shape (n,).

    Raises:
        QpFailure: no solution.
    """
    if daqp is not None:
        sense = np.zeros(len(low) + len(row_low), np.int32)
        sense[len(low):][soft] = _SOFT
        x, _, flag, _ = daqp.solve(H, h, rows, np.concatenate([high, row_high]), np.concatenate([low, row_low]), sense)
        if flag < 1:
            raise QpFailure(f"daqp: exit flag {flag}")
        return x
    return solve_osqp(H, h, low, high, rows, row_low, row_high, soft)


def solve_osqp(H, h, low, high, rows, row_low, row_high, soft) -> np.ndarray:
    """As `solve`, with OSQP; soft rows get slack variables."""
    import osqp  # with scipy.sparse 0.1 s of a start that uses DAQP
    from scipy import sparse

    n, m, k = len(h), len(row_low), int(np.count_nonzero(soft))
    slack = np.zeros((m, k))
    slack[np.flatnonzero(soft), np.arange(k)] = 1.0
    P = np.zeros((n + k, n + k))
    P[:n, :n] = H
    P[n:, n:] = 1e6 * np.eye(k)
    A = np.block([[np.eye(n), np.zeros((n, k))], [rows, slack]]) if m else np.eye(n)
    problem = osqp.OSQP()
    problem.setup(sparse.csc_matrix(np.triu(P)), np.concatenate([h, np.zeros(k)]), sparse.csc_matrix(A),
                  np.concatenate([low, row_low]), np.concatenate([high, row_high]),
                  verbose=False, eps_abs=1e-6, eps_rel=1e-6, max_iter=4000, polishing=True)
    result = problem.solve(raise_error=False)
    if result.info.status_val not in (1, 2):
        raise QpFailure(f"osqp: {result.info.status}")
    return result.x[:n]
