"""Sturm's chain in exact rational arithmetic: the oracle for bound checks. About 7 ms for degree 24."""

from __future__ import annotations

from fractions import Fraction
from math import comb, gcd


def powers_of(bernstein) -> list[Fraction]:
    """Ascending powers, exactly, from Bernstein coefficients that are floats or fractions."""
    n = len(bernstein) - 1
    exact = [Fraction(c) for c in bernstein]
    return [sum(((-1) ** (k - i) * comb(n, k) * comb(k, i) * exact[i] for i in range(k + 1)), Fraction(0)) for k in range(n + 1)]


def _integers(powers) -> list[int]:
    fractions = [Fraction(c) for c in powers]
    common = 1
    for c in fractions:
        common = common * c.denominator // gcd(common, c.denominator)
    out = [int(c * common) for c in fractions]
    while out and out[-1] == 0:
        out.pop()
    return out


def _primitive(poly: list[int]) -> list[int]:
    divisor = 0
    for c in poly:
        divisor = gcd(divisor, c)
    return [c // divisor for c in poly] if divisor > 1 else poly


def _negative_remainder(a: list[int], b: list[int]) -> list[int]:
    """-rem(a, b) times a positive number."""
    a, lead = a[:], b[-1]
    while len(a) >= len(b):
        head, shift = a[-1], len(a) - len(b)
        a = [c * abs(lead) for c in a]
        factor = head if lead > 0 else -head
        for i, c in enumerate(b):
            a[i + shift] -= factor * c
        a.pop()
        while a and a[-1] == 0:
            a.pop()
    return [-c for c in a]


def count_roots(powers, low: Fraction = Fraction(0), high: Fraction = Fraction(1)) -> int:
    """Number of distinct real roots in (low, high]."""
    first = _primitive(_integers(powers))
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
            value = Fraction(0)
            for c in reversed(poly):
                value = value * x + c
            if value:
                signs.append(value > 0)
        return sum(a != b for a, b in zip(signs, signs[1:]))

    return changes(low) - changes(high)


def stays_below(bernstein, bound) -> bool:
    """Whether a polynomial in Bernstein form is < bound on [0, 1], exactly."""
    shifted = [Fraction(c) - Fraction(bound) for c in bernstein]
    return shifted[0] < 0 and shifted[-1] < 0 and count_roots(powers_of(shifted)) == 0
