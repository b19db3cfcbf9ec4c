"""Certificates of a plan: its bounds, in the units of their quantities."""

from __future__ import annotations

import numpy as np

from perch_core.arrays import Array
from perch_core.jit import compiled
from perch_core.values import Certificate
from perch_planner import plan_checks
from perch_planner.contact_constraints import INSET
from perch_planner.problem import Limits
from perch_planner.search import Outcome, Search

_SAMPLED = ("clearance", "body_rate", "rotor_thrust")
"""Quantities whose extrema are those of samples where their limits do not hold."""


def certificates(results: np.ndarray, limits: Limits, mass: float) -> tuple[Certificate, ...]:
    """Convert results of `plan_checks.check` into certificates.

    Args:
        results: rows of `plan_checks.NAMES`, shape (5, 5), or (6, 5) where the rotors were checked.
        limits: the required limits.
        mass: factor from specific thrust to thrust [kg].
    """
    inf = float("inf")
    table = (("N", *limits.thrust, mass, "bernstein"), ("m/s", -inf, limits.speed, 1.0, "bernstein"),
             ("m", *limits.height, 1.0, "bernstein"), ("m", limits.clearance, inf, 1.0, "bernstein"),
             ("rad/s", -inf, limits.body_rate, 1.0, "bernstein"), ("N", *limits.rotor_thrust, 1.0, "interval"))
    rows, out = results.tolist(), []
    others_hold = all(row[plan_checks.HOLDS] for row in rows[:plan_checks.ROTOR_THRUST])  # else the rotors are not proved
    for quantity, row, (unit, low, high, scale, method) in zip(plan_checks.NAMES, rows, table):
        minimum, at_minimum, maximum, at_maximum, holds = row
        if not holds and quantity in _SAMPLED or quantity == "rotor_thrust" and not others_hold:
            method = "dense"
        out.append(Certificate(quantity=quantity, unit=unit, lower_limit=low, upper_limit=high, minimum=scale * minimum,
                               maximum=scale * maximum, time_of_minimum=at_minimum, time_of_maximum=at_maximum, method=method,
                               holds=bool(holds)))
    return tuple(out)


@compiled
def _impact(coefficients: Array, durations: Array, v_S: Array, s3: Array) -> tuple[float, float]:
    """Final speed along -s3, relative to the surface [m/s], and its time [s]; arguments as for `plan_checks.check`."""
    last, speed = coefficients[-1], 0.0
    degree = last.shape[1] - 1
    for d in range(3):
        speed -= s3[d] * (degree * (last[d, degree] - last[d, degree - 1]) / durations[-1] - v_S[d])
    return speed, durations.sum()


def perch_certificates(search: Search, outcome: Outcome) -> tuple[Certificate, ...]:
    """Certificates of a perch: those of `certificates`, and the speed along -s3 at the planned contact, relative to S. [M:eq14]

    The bounds of the speed may be equal, and a plan meets them only to rounding: it may exceed them by `INSET`.

    Args:
        search: provides the problem and its limits.
        outcome: result of the search; where its limits were not checked, there are no certificates.
    """
    if not len(outcome.results):
        return ()
    least, most, plan_limits = search.settings.impact_speed_min, search.settings.impact_speed_max, search.plan_limits
    speed, end = _impact(outcome.coefficients, outcome.durations, plan_limits.v_S, plan_limits.s3)
    impact = Certificate(quantity="impact_speed", unit="m/s", lower_limit=least, upper_limit=most, minimum=speed, maximum=speed,
                         time_of_minimum=end, time_of_maximum=end, method="bernstein", holds=bool(least - INSET <= speed <= most + INSET))
    return (*certificates(outcome.results, search.limits, search.vehicle.mass), impact)
