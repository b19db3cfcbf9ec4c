"""The QP of one iteration solved stage by stage: Riccati recursions inside an active-set iteration.

The bounds are on single inputs (hard) and on single states (soft: their squared excess is penalised), so that an active set
changes stage costs only: a clamped input is a number, an exceeded state bound a diagonal term. With a given set the QP is a
linear-quadratic problem without bounds,

    S = B' P_{k+1} A,  M = R + B' P_{k+1} B,  P_k = Q_k + A' P_{k+1} A - S' M^-1 S     (M over the free inputs),

O(N n^3) instead of the O(N^2 n^2) of condensing and the O(N^3) of a dense solver. The next set follows from the solution
(primal-dual active set, a semismooth Newton method): clamped inputs whose gradient points inwards become free, violated bounds
become active. Once the set repeats itself, its solution is that of the QP. The initial set is that of the last period, which is
usually correct; the recursion restarts from the last stage whose set has changed.
"""

from __future__ import annotations

import numpy as np

from perch_core.jit import compiled

FIRST_BOUNDED = 10  # states from the body rates on may have bounds
_TOLERANCE = 1e-10  # by which a bound is passed, or a gradient has the wrong sign, through rounding


class Workspace:
    """Arrays of the recursion, and the active set that is carried from period to period.

    Attributes:
        fixed: inputs at their upper (1) or lower (-1) bound, shape (N, 4).
        soft: states above (1) or below (-1) their bounds, shape (N + 1, n).
    """

    def __init__(self, nodes: int, states: int) -> None:
        N, n = nodes, states
        self.fixed, self.soft = np.zeros((N, 4), np.int8), np.zeros((N + 1, n), np.int8)
        self.arrays = (self.fixed, self.soft, np.zeros((N + 1, n, n)), np.zeros((N + 1, n)), np.zeros((N, 4, n)), np.zeros((N, 4)),
                       np.zeros((N, 4, 4)), np.zeros((N, 4, n)), np.zeros((N, 4)), np.zeros((n, n)), np.zeros((n, n)), np.zeros(n),
                       np.zeros((4, n)))

    def clear(self) -> None:
        """Clear the active set."""
        self.fixed[:], self.soft[:] = 0, 0


@compiled
def _add_bound_penalty(X, soft, x_low, x_high, price, P, p):
    """Add the penalty of the active state bounds to the cost to go of a node."""
    for i in range(FIRST_BOUNDED, len(X)):
        if soft[i] != 0:
            P[i, i] += price[i]
            p[i] += price[i] * (X[i] - (x_high[i] if soft[i] > 0 else x_low[i]))


@compiled
def _subtract_row(x, c, a, k, K):
    """Subtract x times row c from row a of the gains."""
    k[a] -= x * k[c]
    for j in range(K.shape[1]):
        K[a, j] -= x * K[c, j]


@compiled
def _scale_row(x, a, k, K):
    """Multiply row a of the gains by x."""
    k[a] *= x
    for j in range(K.shape[1]):
        K[a, j] *= x


@compiled
def _gains(M, S, m, fixed, low, high, U, K, k, L):
    """Feedback K (4, n) and feed-forward k (4,) of one stage: du = K dx + k. Clamped inputs have K = 0 and k = bound - U."""
    n = K.shape[1]
    for a in range(4):
        if fixed[a] != 0:
            k[a] = (high[a] if fixed[a] > 0 else low[a]) - U[a]
    for a in range(4):
        if fixed[a] != 0:
            for j in range(n):
                K[a, j] = 0.0
            continue
        k[a] = -m[a]
        for b in range(4):
            if fixed[b] != 0:
                k[a] -= M[a, b] * k[b]
        for j in range(n):
            K[a, j] = -S[a, j]
    # Cholesky of the free part of M, with the first substitution on k and K.
    for a in range(4):
        if fixed[a] != 0:
            continue
        for b in range(a + 1):
            if fixed[b] != 0:
                continue
            s = M[a, b]
            for c in range(b):
                if fixed[c] == 0:
                    s -= L[a, c] * L[b, c]
            L[a, b] = s ** 0.5 if a == b else s / L[b, b]
        for c in range(a):
            if fixed[c] == 0:
                _subtract_row(L[a, c], c, a, k, K)
        _scale_row(1.0 / L[a, a], a, k, K)
    for a in range(3, -1, -1):
        if fixed[a] != 0:
            continue
        for c in range(a + 1, 4):
            if fixed[c] == 0:
                _subtract_row(L[c, a], c, a, k, K)
        _scale_row(1.0 / L[a, a], a, k, K)


@compiled
def _backward(last, stages, X, U, R, target, terminal, low, high, x_low, x_high, price, work):
    """Compute cost to go and gains of the stages from `last` to 0."""
    f, At, Bt, Q, q = stages
    fixed, soft, P, p, K, k, M, S, m, W, T, v, L = work
    N, n = U.shape[0], X.shape[1]
    if last == N - 1:
        for i in range(n):
            for j in range(n):
                P[N, i, j] = terminal * Q[N, i, j]
            p[N, i] = terminal * q[N, i]
        _add_bound_penalty(X[N], soft[N], x_low, x_high, price, P[N], p[N])
    for s in range(last, -1, -1):
        A, B, Pn, Ss = At[s], Bt[s], P[s + 1], S[s]
        for i in range(n):  # v = P c + p, c the defect
            v[i] = p[s + 1, i]
        for l in range(n):
            c = f[s, l] - X[s + 1, l]
            for i in range(n):
                v[i] += c * Pn[l, i]
        for j in range(n):  # W = A' P, row by row, as the compiler can vectorise it; most of A is zeros
            for i in range(n):
                W[j, i] = 0.0
            for l in range(n):
                x = A[j, l]
                if x != 0.0:
                    for i in range(n):
                        W[j, i] += x * Pn[l, i]
        for i in range(n):
            for j in range(n):
                T[i, j] = W[j, i]
        for a in range(4):  # S = B' (P A), M = R + B' P B, m its gradient
            for j in range(n):
                Ss[a, j] = 0.0
                L[a, j] = 0.0
            x = R * (U[s, a] - target[s, a])
            for l in range(n):
                y = B[a, l]
                x += y * v[l]
                for j in range(n):
                    Ss[a, j] += y * T[l, j]
                    L[a, j] += y * Pn[l, j]
            m[s, a] = x
        for a in range(4):
            for b in range(a + 1):
                x = 0.0
                for l in range(n):
                    x += L[a, l] * B[b, l]
                M[s, a, b] = x
                M[s, b, a] = x
            M[s, a, a] += R
        _gains(M[s], Ss, m[s], fixed[s], low[s], high[s], U[s], K[s], k[s], L)
        if s == 0:
            break
        Pk, Ks = P[s], K[s]
        for i in range(n):  # P = Q + A' P A + S' K
            for j in range(n):
                Pk[i, j] = Q[s, i, j]
            x = q[s, i]
            for l in range(n):
                y = A[i, l]
                if y != 0.0:
                    x += y * v[l]
                    for j in range(n):
                        Pk[i, j] += y * T[l, j]
            for a in range(4):
                y = Ss[a, i]
                x += y * k[s, a]
                for j in range(n):
                    Pk[i, j] += y * Ks[a, j]
            p[s, i] = x
        _add_bound_penalty(X[s], soft[s], x_low, x_high, price, Pk, p[s])


@compiled
def _forward(stages, X, U, dx0, low, high, x_low, x_high, work, dx, du):
    """Write the solution of the present active set to dx and du, and replace the set by the one that follows from it. Returns the
    last stage whose cost changes with it, -1 where none does."""
    f, At, Bt, _, _ = stages
    fixed, soft, _, _, K, k, M, S, m, _, _, _, _ = work
    N, n = du.shape[0], dx.shape[1]
    changed = -1
    for i in range(n):
        dx[0, i] = dx0[i]
    for s in range(N):
        x, y = dx[s], dx[s + 1]
        for a in range(4):
            z = k[s, a]
            for j in range(n):
                z += K[s, a, j] * x[j]
            du[s, a] = z
        for a in range(4):
            now = fixed[s, a]
            wanted = now
            if now == 0:
                if U[s, a] + du[s, a] > high[s, a] + _TOLERANCE:
                    wanted = 1
                elif U[s, a] + du[s, a] < low[s, a] - _TOLERANCE:
                    wanted = -1
            else:
                g = m[s, a]  # how the cost to go rises with this input
                for b in range(4):
                    g += M[s, a, b] * du[s, b]
                for j in range(n):
                    g += S[s, a, j] * x[j]
                if g * now > _TOLERANCE:
                    wanted = 0
            if wanted != now:
                fixed[s, a] = wanted
                changed = s
        for i in range(n):
            y[i] = f[s, i] - X[s + 1, i]
        for j in range(n):
            z = x[j]
            for i in range(n):
                y[i] += z * At[s, j, i]
        for a in range(4):
            z = du[s, a]
            for i in range(n):
                y[i] += z * Bt[s, a, i]
        for i in range(FIRST_BOUNDED, n):
            z = X[s + 1, i] + y[i]
            wanted = 1 if z > x_high[i] + _TOLERANCE else -1 if z < x_low[i] - _TOLERANCE else 0
            if wanted != soft[s + 1, i]:
                soft[s + 1, i] = wanted
                changed = min(s + 1, N - 1)
    return changed


@compiled
def solve_stages(stages, X, U, dx0, R, target, terminal, low, high, x_low, x_high, price, rounds, work, dx, du):
    """Minimise the stage costs along the linearised dynamics within bounds.

    Args:
        stages: next states, A', B', Q, q of all nodes (`Linearisation.stages`).
        X, U: point of the linearisation, shapes (N + 1, n), (N, 4).
        dx0: deviation of the initial state, shape (n,).
        R, target: weight of the inputs' distance from a target, scalar and shape (N, 4).
        terminal: factor of the last node's cost.
        low, high: bounds of the inputs U + du, shapes (N, 4).
        x_low, x_high: soft bounds of the states X + dx from the body rates on, shapes (n,); infinite: none.
        price: weight of half the squared excess over a state's bound, shape (n,).
        rounds: greatest number of active sets to try.
        work: `Workspace.arrays`.
        dx, du: results: the solution, shapes (N + 1, n), (N, 4).

    Returns:
        Number of active sets tried, 0: the correct one was not found.
    """
    last = U.shape[0] - 1
    for tried in range(rounds):
        _backward(last, stages, X, U, R, target, terminal, low, high, x_low, x_high, price, work)
        last = _forward(stages, X, U, dx0, low, high, x_low, x_high, work, dx, du)
        if last < 0:
            return tried + 1
    return 0
