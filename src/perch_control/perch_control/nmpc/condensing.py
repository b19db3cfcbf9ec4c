"""From linearised stages to a dense QP in the inputs alone (condensing), and back to states (expansion).

With the defects c_k, `dx_{k+1} = A_k dx_k + B_k du_k + c_k`, and the stage cost `dx' Q dx / 2 + q' dx + R |du|^2 / 2 + r' du`,
eliminating dx leaves `du' H du / 2 + h' du`. A forward recursion gives the input-to-state matrices, a backward one H, row block by row block in O(N^2).
"""

from __future__ import annotations

import numpy as np

from perch_core.jit import COMPILED, compiled


@compiled
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


@compiled
def condense_loops(A, B, c, Q, q, r, R, dx0, H, h, xi, G):
    """H and h of the condensed QP, the free response xi and the input-to-state matrices G.

    Args:
        A, B, c: linearised dynamics, shapes (N, n, n), (N, n, 4), (N, n).
        Q, q: state cost at the nodes, shapes (N + 1, n, n), (N + 1, n); node 0 does not count.
        r, R: gradient (N, 4) and weight (scalar) of the input cost.
        dx0: deviation of the initial state, shape (n,).
        H, h: results, shapes (4N, 4N), (4N,).
        xi: response to dx0 and c alone, shape (N + 1, n).
        G: G[k] = d x_k / d u, shape (N + 1, n, 4N); zero at k = 0 and right of the diagonal when it comes in.
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
    # The innermost loops run along rows of G, W and H, so that the compiler can vectorise them. Half of A and five sixths of Q
    # are zeros, which are passed over: up to half of the time.
    for k in range(N):
        m = 4 * k
        for i in range(n):
            for j in range(m):
                G[k + 1, i, j] = 0.0
            for l in range(n):
                x = A[k, i, l]
                if x == 0.0:
                    continue
                for j in range(m):
                    G[k + 1, i, j] += x * G[k, l, j]
            for a in range(4):
                G[k + 1, i, m + a] = B[k, i, a]
    W, W2 = np.zeros((n, 4 * N)), np.zeros((n, 4 * N))
    for k in range(N, 0, -1):
        m = 4 * k
        for i in range(n):
            for j in range(m):
                W2[i, j] = 0.0
            for l in range(n):
                x = Q[k, i, l]
                if x == 0.0:
                    continue
                for j in range(m):
                    W2[i, j] += x * G[k, l, j]
            if k < N:
                for l in range(n):
                    x = A[k, l, i]
                    if x == 0.0:
                        continue
                    for j in range(m):
                        W2[i, j] += x * W[l, j]
        for i in range(n):
            for j in range(m):
                W[i, j] = W2[i, j]
        for a in range(4):
            row = m - 4 + a
            for j in range(m):
                H[row, j] = 0.0
            for i in range(n):
                x = B[k - 1, i, a]
                for j in range(m):
                    H[row, j] += x * W[i, j]
    for i in range(4 * N):
        H[i, i] += R
        for j in range(i):
            H[j, i] = H[i, j]


def condense_matrices(A, B, c, Q, q, r, R, dx0, H, h, xi, G) -> None:
    """The same with numpy's matrix products: the second implementation, and the one without numba."""
    N, n = c.shape
    xi[0] = dx0
    for k in range(N):
        xi[k + 1] = A[k] @ xi[k] + c[k]
    G[:] = 0.0
    for k in range(N):
        G[k + 1] = A[k] @ G[k]
        G[k + 1][:, 4 * k:4 * k + 4] += B[k]
    stacked = G[1:].reshape(N * n, 4 * N)
    weighted = (Q[1:] @ G[1:]).reshape(N * n, 4 * N)
    H[:] = stacked.T @ weighted + R * np.eye(4 * N)
    gradient = q[1:] + np.einsum("kij,kj->ki", Q[1:], xi[1:])
    h[:] = stacked.T @ gradient.ravel() + r.ravel()


condense = condense_loops if COMPILED else condense_matrices


@compiled
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
