"""Dense QP of one iteration in the inputs alone: for machines without numba, and where `riccati` finds no active set.

With the defects c_k, `dx_{k+1} = A_k dx_k + B_k du_k + c_k`, and the stage cost `dx' Q dx / 2 + q' dx + R |du|^2 / 2 + r' du`,
eliminating dx leaves `du' H du / 2 + h' du`; bounds of states become rows. It also serves the tests as an independent
implementation to compare `riccati` with.
"""

from __future__ import annotations

import numpy as np

from perch_control.nmpc.qp import solve
from perch_control.nmpc.riccati import FIRST_BOUNDED


def condense(A: np.ndarray, B: np.ndarray, c: np.ndarray, Q: np.ndarray, q: np.ndarray, r: np.ndarray, R: float,
             dx0: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Cost of the inputs, and the states as a function of them.

    Args:
        A, B, c: linearised dynamics, shapes (N, n, n), (N, n, 4), (N, n).
        Q, q: state cost at the nodes, shapes (N + 1, n, n), (N + 1, n); node 0 does not count.
        r, R: gradient (N, 4) and weight (scalar) of the input cost.
        dx0: deviation of the initial state, shape (n,).

    Returns:
        H (4N, 4N), h (4N,); the response xi (N + 1, n) to dx0 and c alone, and G (N + 1, n, 4N): dx = xi + G du.
    """
    N, n = c.shape
    xi, G = np.zeros((N + 1, n)), np.zeros((N + 1, n, 4 * N))
    xi[0] = dx0
    for k in range(N):
        xi[k + 1] = A[k] @ xi[k] + c[k]
        G[k + 1] = A[k] @ G[k]
        G[k + 1][:, 4 * k:4 * k + 4] += B[k]
    stacked = G[1:].reshape(N * n, 4 * N)
    weighted = (Q[1:] @ G[1:]).reshape(N * n, 4 * N)
    gradient = q[1:] + np.einsum("kij,kj->ki", Q[1:], xi[1:])
    return stacked.T @ weighted + R * np.eye(4 * N), stacked.T @ gradient.ravel() + r.ravel(), xi, G


def solve_condensed(stages: tuple[np.ndarray, ...], X: np.ndarray, U: np.ndarray, dx0: np.ndarray, R: float, target: np.ndarray,
                    terminal: float, low: np.ndarray, high: np.ndarray, x_low: np.ndarray,
                    x_high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Solve the problem of `riccati.solve_stages`, with the same arguments: returns dx (N + 1, n) and du (N, 4).

    Raises:
        QpFailure: no solution.
    """
    following, At, Bt, Q, q = stages
    N, n = len(U), X.shape[1]
    A, B = At[:N].transpose(0, 2, 1), Bt[:N].transpose(0, 2, 1)
    factor = np.append(np.ones(N), terminal)
    H, h, xi, G = condense(A, B, following[:N] - X[1:], factor[:, None, None] * Q, factor[:, None] * q, R * (U - target), R, dx0)
    bounded = np.arange(FIRST_BOUNDED, n)[np.isfinite(x_high[FIRST_BOUNDED:])]
    free = (X + xi)[1:, bounded].ravel()
    rows = G[1:, bounded].reshape(-1, 4 * N)
    du = solve(H, h, (low - U).ravel(), (high - U).ravel(), rows, np.tile(x_low[bounded], N) - free,
               np.tile(x_high[bounded], N) - free, np.ones(len(rows), bool))
    return xi + G @ du, du.reshape(N, 4)
