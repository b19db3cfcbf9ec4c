"""Taylor models of second order in time, as tuples of floats for compiled code, to prove that a function keeps its limits.

A number (m, d, c, e) stands for a function x on [-1, 1]: m = x(0), d = x'(0), and |x'' - c| <= e everywhere. So

    x(t) = m + d t + k t^2 / 2   for a k in [c - e, c + e] that depends on t.

Arithmetic preserves this (Makino and Berz, 2003; here with rigorous second derivatives instead of remainders). Rounding errors
are not tracked: the caller widens a bound by `ROUNDING`. Functions have no branches and are inlined into the calling loop.
"""

from __future__ import annotations

from math import sqrt

from perch_core.jit import compiled

Taylor = tuple[float, float, float, float]
Vector = tuple[Taylor, Taylor, Taylor]

ROUNDING = 1e-9
ZERO = (0.0, 0.0, 0.0, 0.0)
_POSITIVE = 1e-12  # instead of what has to be positive, where it is not: no branches, so that compiled loops take several elements at a time


@compiled(inline=True)
def sizes(a: Taylor) -> tuple[float, float, float]:
    """Greatest absolute values of a function and of its first two derivatives."""
    bend = abs(a[2]) + a[3]
    return abs(a[0]) + abs(a[1]) + 0.5 * bend, abs(a[1]) + bend, bend


@compiled(inline=True)
def greatest(a: Taylor) -> float:
    """An upper bound of the function."""
    bend, slope = a[2] + a[3], abs(a[1])
    inside, end = a[0] - 0.5 * slope * slope / min(bend, -_POSITIVE), a[0] + slope + 0.5 * bend
    return inside if bend < -slope else end


@compiled(inline=True)
def least(a: Taylor) -> float:
    """A lower bound of the function."""
    return -greatest((-a[0], -a[1], -a[2], a[3]))


@compiled(inline=True)
def add(a: Taylor, b: Taylor) -> Taylor:
    """`a + b`."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2], a[3] + b[3]


@compiled(inline=True)
def sub(a: Taylor, b: Taylor) -> Taylor:
    """`a - b`."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2], a[3] + b[3]


@compiled(inline=True)
def times(k: float, a: Taylor) -> Taylor:
    """`k a` for a constant."""
    return k * a[0], k * a[1], k * a[2], abs(k) * a[3]


@compiled(inline=True)
def mul(a: Taylor, b: Taylor) -> Taylor:
    """`a b`; (a b)'' = a'' b + 2 a' b' + a b'', and each term is at most the product of the sizes."""
    a0, a1, a2 = sizes(a)
    b0, b1, b2 = sizes(b)
    p, q, r = a[2] * b[0], a[1] * b[1], a[0] * b[2]
    return (a[0] * b[0], a[1] * b[0] + a[0] * b[1], p + 2.0 * q + r,
            a2 * b0 - abs(p) + 2.0 * (a1 * b1 - abs(q)) + a0 * b2 - abs(r))


@compiled(inline=True)
def chained(value: float, slope: float, slope_reach: float, bend: float, bend_reach: float, a: Taylor) -> Taylor:
    """g(a) from g, g', g'' at m and the greatest deviations of g' and g'' from there; g(a)'' = g'' a'^2 + g' a''."""
    _, a1, a2 = sizes(a)
    p, q = bend * a[1] * a[1], slope * a[2]
    return (value, slope * a[1], p + q,
            (abs(bend) + bend_reach) * a1 * a1 - abs(p) + (abs(slope) + slope_reach) * a2 - abs(q))


@compiled(inline=True)
def inverse_root(a: Taylor) -> Taylor:
    """`a^(-1/2)` where `least(a)` is positive; its derivatives are monotonic, so they deviate most at the extrema of a."""
    here, most, fewest = 1.0 / sqrt(max(a[0], _POSITIVE)), 1.0 / sqrt(max(least(a), _POSITIVE)), 1.0 / sqrt(max(greatest(a), _POSITIVE))
    return chained(here, -0.5 * here**3, 0.5 * max(most**3 - here**3, here**3 - fewest**3),
                   0.75 * here**5, 0.75 * max(most**5 - here**5, here**5 - fewest**5), a)


@compiled(inline=True)
def sine(a: Taylor, s: float, c: float) -> Taylor:
    """`sin a`; s, c: sine and cosine of a's middle."""
    reach = sizes(a)[0] - abs(a[0])  # no derivative of a sine changes by more
    return chained(s, c, reach, -s, reach, a)


@compiled(inline=True)
def vector_add(a: Vector, b: Vector) -> Vector:
    """`a + b` of vectors."""
    return add(a[0], b[0]), add(a[1], b[1]), add(a[2], b[2])


@compiled(inline=True)
def axpy(k: Taylor, a: Vector, b: Vector) -> Vector:
    """`k a + b` for a number k and vectors."""
    return add(mul(k, a[0]), b[0]), add(mul(k, a[1]), b[1]), add(mul(k, a[2]), b[2])


@compiled(inline=True)
def scale(k: Taylor, a: Vector) -> Vector:
    """`k a` for a number k and a vector."""
    return mul(k, a[0]), mul(k, a[1]), mul(k, a[2])


@compiled(inline=True)
def dot(a: Vector, b: Vector) -> Taylor:
    """Scalar product."""
    return add(add(mul(a[0], b[0]), mul(a[1], b[1])), mul(a[2], b[2]))


@compiled(inline=True)
def cross(a: Vector, b: Vector) -> Vector:
    """Vector product."""
    return (sub(mul(a[1], b[2]), mul(a[2], b[1])), sub(mul(a[2], b[0]), mul(a[0], b[2])), sub(mul(a[0], b[1]), mul(a[1], b[0])))
