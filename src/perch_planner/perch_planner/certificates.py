"""Bounds that a plan carries with it, in the units of their quantities."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from perch_planner import plan_checks
from perch_planner.problem import Limits


class Certificate(NamedTuple):
    """A proved bound on one quantity of a plan; fields as in `perch_msgs/Certificate`.

    Attributes:
        quantity: thrust, speed, height, clearance, body_rate or rotor_thrust.
        unit: unit of the values.
        lower_limit, upper_limit: required bounds, infinite where there is none.
        minimum, maximum: proved bounds of the quantity, infinite where none was asked for.
        time_of_minimum, time_of_maximum: times of the samples nearest to the proved bounds [s]; nan: none.
        method: bernstein, sturm or dense; dense is sampled, and no proof.
        holds: the limits are kept.
    """

    quantity: str
    unit: str
    lower_limit: float
    upper_limit: float
    minimum: float
    maximum: float
    time_of_minimum: float
    time_of_maximum: float
    method: str
    holds: bool

    def describe(self) -> str:
        """One line for people."""
        return (f"{self.quantity} in [{self.minimum:.4g}, {self.maximum:.4g}] {self.unit}, required "
                f"[{self.lower_limit:.4g}, {self.upper_limit:.4g}]: {self._verdict()} ({self.method})")

    def _verdict(self) -> str:
        kept = "kept" if self.method == "dense" else "proved"
        return kept if self.holds else f"not {kept}"


def certificates(results: np.ndarray, limits: Limits, mass: float, thrust_method: str = "bernstein") -> tuple[Certificate, ...]:
    """The certificates of `plan_checks.check`.

    Args:
        results: rows of `plan_checks.NAMES`, shape (5, 5), or (6, 5) where the rotors were looked at.
        limits: what was required.
        mass: turns specific thrust into thrust [kg].
        thrust_method: who decided the thrust bound.
    """
    inf = float("inf")
    table = (("N", limits.thrust[0], limits.thrust[1], mass, thrust_method),
             ("m/s", -inf, limits.speed, 1.0, "bernstein"),
             ("m", limits.height[0], limits.height[1], 1.0, "bernstein"),
             ("m", limits.clearance, inf, 1.0, "bernstein"),
             ("rad/s", -inf, limits.body_rate, 1.0, "bernstein"),
             ("N", *limits.rotor_thrust, 1.0, "dense"))
    out = []
    for quantity, row, (unit, low, high, scale, method) in zip(plan_checks.NAMES, results.tolist(), table):
        minimum, at_minimum, maximum, at_maximum, holds = row
        if quantity == "rotor_thrust":  # preferred limits are searched without them
            holds = low <= minimum and maximum <= high
        out.append(Certificate(quantity, unit, low, high, scale * minimum, scale * maximum, at_minimum, at_maximum,
                               method, bool(holds)))
    return tuple(out)
