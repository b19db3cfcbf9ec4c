"""Bounds that a plan carries with it, in the units of their quantities."""

from __future__ import annotations

import numpy as np

from perch_core.values import Certificate
from perch_planner import plan_checks
from perch_planner.problem import Limits


def certificates(results: np.ndarray, limits: Limits, mass: float) -> tuple[Certificate, ...]:
    """The certificates of `plan_checks.check`.

    Args:
        results: rows of `plan_checks.NAMES`, shape (5, 5), or (6, 5) where the rotors were looked at.
        limits: what was required.
        mass: turns specific thrust into thrust [kg].
    """
    inf = float("inf")
    table = (("N", *limits.thrust, mass, "bernstein"), ("m/s", -inf, limits.speed, 1.0, "bernstein"),
             ("m", *limits.height, 1.0, "bernstein"), ("m", limits.clearance, inf, 1.0, "bernstein"),
             ("rad/s", -inf, limits.body_rate, 1.0, "bernstein"), ("N", *limits.rotor_thrust, 1.0, "interval"))
    out = []
    for quantity, row, (unit, low, high, scale, method) in zip(plan_checks.NAMES, results.tolist(), table):
        minimum, at_minimum, maximum, at_maximum, holds = row
        out.append(Certificate(quantity=quantity, unit=unit, lower_limit=low, upper_limit=high, minimum=scale * minimum,
                               maximum=scale * maximum, time_of_minimum=at_minimum, time_of_maximum=at_maximum, method=method,
                               holds=bool(holds)))
    return tuple(out)
