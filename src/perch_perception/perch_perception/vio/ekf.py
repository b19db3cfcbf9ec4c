"""Linear algebra of an EKF update: gate, projection, compression, correction."""

from __future__ import annotations

import numpy as np
from scipy.linalg import cho_factor, cho_solve, qr, solve_triangular
from scipy.stats import chi2


class Gate:
    """chi2 thresholds of one probability, kept by dimension."""

    def __init__(self, probability: float, most: int = 400) -> None:
        self._limits = np.concatenate([[0.0], chi2.ppf(probability, np.arange(1, most + 1))])

    def limit(self, dimension: int) -> float:
        """Largest normalised innovation squared of this dimension that passes."""
        return float(self._limits[min(dimension, len(self._limits) - 1)])


def squared_distance(H: np.ndarray, P: np.ndarray, r: np.ndarray, variance: float) -> float:
    """r^T (H P H^T + variance I)^-1 r for H (m, n), P (n, n), r (m,)."""
    S = H @ P @ H.T
    S[np.diag_indices_from(S)] += variance
    L = np.linalg.cholesky(S)
    half = solve_triangular(L, r, lower=True, check_finite=False)
    return float(half @ half)


def eliminate(H_x: np.ndarray, H_f: np.ndarray, r: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Split r = H_x x + H_f f + n into a part that tells f and a part free of it, by an orthogonal transformation.

    Args:
        H_x: shape (m, n); H_f: shape (m, 3); r: shape (m,); m > 3.

    Returns:
        R_f (3, 3) upper triangular, H_1 (3, n), r_1 (3,) with r_1 = H_1 x + R_f f;
        H_0 (m - 3, n), r_0 (m - 3,) with r_0 = H_0 x.
    """
    Q, R = np.linalg.qr(H_f, mode="complete")
    QH, Qr = Q.T @ H_x, Q.T @ r
    return R[:3], QH[:3], Qr[:3], QH[3:], Qr[3:]


def compress(H: np.ndarray, r: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same information in at most n rows, by QR; H (m, n), r (m,)."""
    if H.shape[0] <= H.shape[1]:
        return H, r
    R = qr(np.column_stack([H, r]), mode="r", check_finite=False)[0]
    n = H.shape[1]
    return R[:n, :n], R[:n, n]


def update(P: np.ndarray, columns: np.ndarray, H: np.ndarray, r: np.ndarray, variance: float | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Kalman update with a Jacobian that touches only some columns.

    Args:
        P: covariance, shape (n, n).
        columns: indices that H's columns stand for, shape (k,).
        H: shape (m, k); r: shape (m,).
        variance: of the measurement noise, a number or one per row (m,).

    Returns:
        Error estimate (n,) and new covariance (n, n), symmetric.
    """
    PH = P[:, columns] @ H.T
    S = H @ PH[columns]
    S[np.diag_indices_from(S)] += variance
    factor = cho_factor(S, lower=True, check_finite=False)
    K = cho_solve(factor, PH.T, check_finite=False).T
    P = P - K @ PH.T
    return K @ r, 0.5 * (P + P.T)
