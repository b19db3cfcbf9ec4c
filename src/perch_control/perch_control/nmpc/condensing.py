"""From linearised stages to a dense QP in the inputs alone (condensing), and back to states (expansion).

With the defects c_k, `dx_{k+1} = A_k dx_k + B_k du_k + c_k`, and the stage cost `dx' Q dx / 2 + q' dx + R |du|^2 / 2 + r' du`,
eliminating dx leaves `du' H du / 2 + h' du`. Backward recursions give H block by block in O(N^2) [ref. 16 of P].
"""

from __future__ import annotations

import numpy as np

from perch_control.jit import COMPILED, scalar


@scalar
def unpack(results, X, A, B, c, Q, q):
    """Distribute the stage function's results, matrices by columns, into arrays; c are the defects."""
    nodes, n = X.shape
    for k in range(nodes):
        o = results[k]
        p = n
        if k < nodes - 1:
            for i in range(n):
                c[k, i] = o[i] - X[k + 1, i]
            for j in range(n):
                for i in range(n):
                    A[k, i, j] = o[p + j * n + i]
            p += n * n
            for j in range(4):
                for i in range(n):
                    B[k, i, j] = o[p + j * n + i]
            p += 4 * n
        else:
            p += n * n + 4 * n
        for j in range(n):
            for i in range(n):
                Q[k, i, j] = o[p + j * n + i]
        p += n * n
        for i in range(n):
            q[k, i] = o[p + i]


@scalar
def condense_loops(A, B, c, Q, q, r, R, dx0, H, h, xi, G):
    """H and h of the condensed QP, the free response xi and the input-to-state matrices G.

    Args:
        A, B, c: linearised dynamics, shapes (N, n, n), (N, n, 4), (N, n).
        Q, q: state cost at the nodes, shapes (N + 1, n, n), (N + 1, n); node 0 does not count.
        r, R: gradient (N, 4) and weight (scalar) of the input cost.
        dx0: deviation of the initial state, shape (n,).
        H, h: results, shapes (4N, 4N), (4N,).
        xi: response to dx0 and c alone, shape (N + 1, n).
        G: G[j, k] = d x_k / d u_j, shape (N, N + 1, n, 4).
    """
    N, n = c.shape
    for i in range(n):
        xi[0, i] = dx0[i]
    for k in range(N):
        for i in range(n):
            s = c[k, i]
            for j in range(n):
                s += A[k, i, j] * xi[k, j]
            xi[k + 1, i] = s
    lam, tmp = np.zeros(n), np.zeros(n)
    for i in range(n):
        s = q[N, i]
        for j in range(n):
            s += Q[N, i, j] * xi[N, j]
        lam[i] = s
    for k in range(N - 1, -1, -1):
        for a in range(4):
            s = r[k, a]
            for i in range(n):
                s += B[k, i, a] * lam[i]
            h[4 * k + a] = s
        if k > 0:
            for i in range(n):
                s = q[k, i]
                for j in range(n):
                    s += Q[k, i, j] * xi[k, j] + A[k, j, i] * lam[j]
                tmp[i] = s
            for i in range(n):
                lam[i] = tmp[i]
    W, W2 = np.zeros((n, 4)), np.zeros((n, 4))
    for j in range(N):
        Gj = G[j]
        for i in range(n):
            for a in range(4):
                Gj[j + 1, i, a] = B[j, i, a]
        for k in range(j + 1, N):
            for i in range(n):
                s0, s1, s2, s3 = 0.0, 0.0, 0.0, 0.0
                for l in range(n):
                    x = A[k, i, l]
                    s0 += x * Gj[k, l, 0]
                    s1 += x * Gj[k, l, 1]
                    s2 += x * Gj[k, l, 2]
                    s3 += x * Gj[k, l, 3]
                Gj[k + 1, i, 0], Gj[k + 1, i, 1], Gj[k + 1, i, 2], Gj[k + 1, i, 3] = s0, s1, s2, s3
        for i in range(n):
            for a in range(4):
                W[i, a] = 0.0
        for k in range(N, j, -1):
            for i in range(n):
                s0, s1, s2, s3 = 0.0, 0.0, 0.0, 0.0
                for l in range(n):
                    x = Q[k, i, l]
                    s0 += x * Gj[k, l, 0]
                    s1 += x * Gj[k, l, 1]
                    s2 += x * Gj[k, l, 2]
                    s3 += x * Gj[k, l, 3]
                if k < N:
                    for l in range(n):
                        x = A[k, l, i]
                        s0 += x * W[l, 0]
                        s1 += x * W[l, 1]
                        s2 += x * W[l, 2]
                        s3 += x * W[l, 3]
                W2[i, 0], W2[i, 1], W2[i, 2], W2[i, 3] = s0, s1, s2, s3
            for i in range(n):
                for a in range(4):
                    W[i, a] = W2[i, a]
            for a in range(4):
                for b in range(4):
                    s = 0.0
                    for i in range(n):
                        s += B[k - 1, i, a] * W[i, b]
                    H[4 * (k - 1) + a, 4 * j + b] = s
                    H[4 * j + b, 4 * (k - 1) + a] = s
        for a in range(4):
            H[4 * j + a, 4 * j + a] += R


def condense_matrices(A, B, c, Q, q, r, R, dx0, H, h, xi, G) -> None:
    """The same with numpy's matrix products: the second implementation, and the one without numba."""
    N, n = c.shape
    xi[0] = dx0
    for k in range(N):
        xi[k + 1] = A[k] @ xi[k] + c[k]
    G[:] = 0.0
    for j in range(N):
        G[j, j + 1] = B[j]
        for k in range(j + 1, N):
            G[j, k + 1] = A[k] @ G[j, k]
    stacked = np.concatenate([G[j, 1:].reshape(N * n, 4) for j in range(N)], axis=1)
    weighted = np.einsum("kij,kjm->kim", Q[1:], stacked.reshape(N, n, 4 * N)).reshape(N * n, 4 * N)
    H[:] = stacked.T @ weighted + R * np.eye(4 * N)
    gradient = q[1:] + np.einsum("kij,kj->ki", Q[1:], xi[1:])
    h[:] = stacked.T @ gradient.ravel() + r.ravel()


condense = condense_loops if COMPILED else condense_matrices


@scalar
def expand_loops(A, B, c, dx0, du, X, U):
    """Add the QP's solution to the trajectory: inputs, and states by the linearised dynamics."""
    N, n = c.shape
    d, e = dx0.copy(), np.zeros(n)
    for i in range(n):
        X[0, i] += d[i]
    for k in range(N):
        for i in range(n):
            s = c[k, i]
            for j in range(n):
                s += A[k, i, j] * d[j]
            for a in range(4):
                s += B[k, i, a] * du[4 * k + a]
            e[i] = s
        for i in range(n):
            d[i] = e[i]
            X[k + 1, i] += d[i]
        for a in range(4):
            U[k, a] += du[4 * k + a]


def expand_matrices(A, B, c, dx0, du, X, U) -> None:
    """The same with numpy's matrix products."""
    d = dx0.copy()
    X[0] += d
    for k in range(len(c)):
        d = A[k] @ d + B[k] @ du[4 * k:4 * k + 4] + c[k]
        X[k + 1] += d
        U[k] += du[4 * k:4 * k + 4]


expand = expand_loops if COMPILED else expand_matrices
