"""Linear algebra of an EKF update: gate, projection, compression, correction."""

from __future__ import annotations

import math

import numpy as np
from perch_core.jit import compiled
from perch_core.probability import chi2_quantile
from scipy.linalg import lapack, qr


class Gate:
    """chi2 thresholds of one probability, precomputed by dimension."""

    def __init__(self, probability: float, most: int = 400) -> None:
        self._limits = np.concatenate([[0.0], chi2_quantile(probability, np.arange(1, most + 1))])

    def limit(self, dimension: int) -> float:
        """Return the largest normalised innovation squared of this dimension that passes."""
        return float(self._limits[min(dimension, len(self._limits) - 1)])


def squared_distance(H: np.ndarray, P: np.ndarray, r: np.ndarray, variance: float) -> float:
    """r^T (H P H^T + variance I)^-1 r for H (m, n), P (n, n), r (m,)."""
    S = H @ P @ H.T
    S.flat[:: len(S) + 1] += variance
    half = _solve_lower(_cholesky(S), r)
    return float(half @ half)


@compiled
def _reflect(A, columns):
    """Apply Householder QR of the first columns of A (m, n) to all of A in place."""
    m, n = A.shape
    v, w = np.zeros(m), np.zeros(n)
    for c in range(columns):
        norm2 = 0.0
        for i in range(c, m):
            v[i] = A[i, c]
            norm2 += v[i] * v[i]
        norm = math.sqrt(norm2)
        if norm == 0.0:
            continue
        head = norm if v[c] >= 0.0 else -norm
        v[c] += head
        factor = 1.0 / (norm2 + abs(A[c, c]) * norm)  # 2 / |v|^2
        w[:] = 0.0
        for i in range(c, m):
            for j in range(c, n):
                w[j] += v[i] * A[i, j]
        for i in range(c, m):
            f = factor * v[i]
            for j in range(c, n):
                A[i, j] -= f * w[j]
        for i in range(c + 1, m):
            A[i, c] = 0.0


def _cholesky(S: np.ndarray) -> np.ndarray:
    L, info = lapack.dpotrf(S, lower=1, clean=0)
    if info:
        raise np.linalg.LinAlgError(f"innovation covariance is not positive definite (dpotrf: {info})")
    return L


def _solve_lower(L: np.ndarray, b: np.ndarray) -> np.ndarray:
    return lapack.dtrtrs(L, b, lower=1)[0]


def eliminate(H_x: np.ndarray, H_f: np.ndarray, r: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Split r = H_x x + H_f f + n into a part that determines f and a part without f, by an orthogonal transformation.

    Args:
        H_x: shape (m, n); H_f: shape (m, 3); r: shape (m,); m > 3.

    Returns:
        R_f (3, 3) upper triangular, H_1 (3, n), r_1 (3,) with r_1 = H_1 x + R_f f;
        H_0 (m - 3, n), r_0 (m - 3,) with r_0 = H_0 x.
    """
    A = np.column_stack([H_f, H_x, r])
    _reflect(A, 3)
    return A[:3, :3], A[:3, 3:-1], A[:3, -1], A[3:, 3:-1], A[3:, -1]


def compress(H: np.ndarray, r: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Reduce H (m, n), r (m,) to at most n rows with the same information, by QR."""
    if H.shape[0] <= H.shape[1]:
        return H, r
    R = qr(np.column_stack([H, r]), mode="r", check_finite=False)[0]
    n = H.shape[1]
    return R[:n, :n], R[:n, n]


def update(P: np.ndarray, columns: np.ndarray, H: np.ndarray, r: np.ndarray,
           variance: float | np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Kalman update with a Jacobian that touches only some columns.

    Args:
        P: covariance, shape (n, n).
        columns: indices in the error vector of H's columns, shape (k,).
        H: shape (m, k); r: shape (m,).
        variance: of the measurement noise, a number or one per row (m,).

    Returns:
        Error estimate (n,), new covariance (n, n), symmetric, and the normalised innovation squared r^T S^-1 r, of dimension m.
    """
    HP = H @ P[columns]
    S = HP[:, columns] @ H.T
    S.flat[:: len(S) + 1] += variance
    L = _cholesky(S)
    half = _solve_lower(L, HP)  # P H^T S^-1 H P = half^T half, symmetric to the last bit
    white = _solve_lower(L, r)
    return half.T @ white, P - half.T @ half, float(white @ white)
