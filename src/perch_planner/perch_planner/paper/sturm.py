"""Algorithm 1 as printed in the paper: global bound checking by Sturm's chain.

The chain of a polynomial of degree 24 is ill-conditioned in floating point: at a relative margin of 1e-6 it accepts
70 of 600 polynomials that violate their bound. The shipped planner uses `perch_planner.bounds` instead.
"""

from __future__ import annotations

import numpy as np

from perch_core.arrays import Array
from perch_core.jit import compiled


@compiled
def sturm_chain(powers: Array) -> tuple[Array, np.ndarray]:
    """S_0 ... S_N of a polynomial in ascending powers, each scaled to a largest coefficient of 1. [defines M:eq18]

    Returns:
        (chain, degrees): chain, shape (m, n + 1), and the degree of each member, shape (m,).
    """
    n = len(powers)
    chain = np.zeros((n + 1, n))
    degrees = np.zeros(n + 1, np.int64)
    largest = np.abs(powers).max()
    degree = n - 1
    while degree > 0 and powers[degree] == 0.0:
        degree -= 1
    chain[0] = powers / max(largest, 1e-300)
    degrees[0] = degree
    if degree == 0:
        return chain[:1], degrees[:1]
    for i in range(1, degree + 1):
        chain[1, i - 1] = i * chain[0, i]
    chain[1] /= np.abs(chain[1]).max()
    degrees[1] = degree - 1
    count = 2
    while degrees[count - 1] > 0:
        high, low = degrees[count - 2], degrees[count - 1]
        rest = chain[count - 2].copy()
        for j in range(high, low - 1, -1):
            factor = rest[j] / chain[count - 1, low]
            for i in range(low + 1):
                rest[j - low + i] -= factor * chain[count - 1, i]
            rest[j] = 0.0
        size = np.abs(rest[:low]).max()
        if size == 0.0:
            break
        degree = low - 1
        while degree > 0 and rest[degree] == 0.0:
            degree -= 1
        chain[count] = -rest / size
        degrees[count] = degree
        count += 1
    return chain[:count], degrees[:count]


@compiled
def _sign_changes(chain: Array, degrees: np.ndarray, x: float) -> int:
    changes, last = 0, 0.0
    for k in range(len(degrees)):
        value = 0.0
        for i in range(degrees[k], -1, -1):
            value = value * x + chain[k, i]
        if value != 0.0:
            if last != 0.0 and (value > 0.0) != (last > 0.0):
                changes += 1
            last = value
    return changes


@compiled
def count_roots(powers: Array, low: float, high: float) -> int:
    """STURM(F, t_0, t_f): number of distinct roots in (low, high]. [M:eq18]

    The example of the appendix, t^4 + t^3 - t - 1, has one in (0, 2]. [defines M:eq19]
    """
    chain, degrees = sturm_chain(powers)
    return _sign_changes(chain, degrees, low) - _sign_changes(chain, degrees, high)


@compiled
def global_bound_check(powers: Array, bound: float, low: float, high: float) -> bool:
    """True if H(t) < bound for all t in [low, high]. [M:alg1]

    Args:
        powers: H, ascending powers of t.
        bound: b.
        low, high: t_0 and t_f.
    """
    f = powers.copy()
    f[0] -= bound
    at_low, at_high = 0.0, 0.0
    for i in range(len(f) - 1, -1, -1):
        at_low = at_low * low + f[i]
        at_high = at_high * high + f[i]
    if at_low >= 0.0 or at_high >= 0.0:  # a multiple root there takes the whole chain to zero, which then counts nothing
        return False
    return count_roots(f, low, high) <= 0
