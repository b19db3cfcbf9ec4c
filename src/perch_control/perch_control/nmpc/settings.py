"""Weights and horizon of the predictive controller."""

from __future__ import annotations

from dataclasses import dataclass

from perch_core.arrays import Vector3
from perch_core.config import part, quantity
from perch_core.errors import ConfigError


@dataclass(frozen=True)
class LineWeights:
    """Soft terms for powerlines; they ramp up from zero. [P:VI-A]"""

    perception: float = quantity(0.0, low=0.0, doc="reprojection error of the first line [P:eq9]")
    visibility: float = quantity(0.0, low=0.0, doc="cheirality and segment visibility of the first line [P:eq12, P:eq13]")
    collision: float = quantity(0.0, low=0.0, doc="clearance from every line [P:eq7]")
    watched: tuple[float, ...] = quantity((), unit="m", doc="rough point in map on the line to keep in view (x, y, z); empty: the nearest line")

    def __post_init__(self) -> None:
        if len(self.watched) not in (0, 3):
            raise ConfigError("", "watched", f"has {len(self.watched)} entries, needs 3 (x, y, z), or none")

    @property
    def any(self) -> bool:
        """Whether any of the terms is enabled."""
        return self.perception > 0.0 or self.visibility > 0.0 or self.collision > 0.0


@dataclass(frozen=True)
class NmpcSettings:
    """Horizon and weights (diagonals of the quadratic cost)."""

    horizon: float = quantity(1.0, unit="s", above=0.05, high=5.0, doc="of the prediction, in N = 20 intervals")
    position: Vector3 = quantity((200.0, 200.0, 300.0), unit="1/m^2", low=0.0, doc="axes of W")
    velocity: Vector3 = quantity((8.0, 8.0, 10.0), unit="s^2/m^2", low=0.0, doc="axes of W")
    attitude: Vector3 = quantity((12.0, 12.0, 4.0), unit="1/rad^2", low=0.0, doc="axes of B")
    rate: Vector3 = quantity((0.08, 0.08, 0.1), unit="s^2/rad^2", low=0.0, doc="axes of B")
    thrust: float = quantity(1.0, unit="1/N^2", above=0.0, doc="distance of the rotor thrusts from the reference's")
    ramps: bool = quantity(False, doc="thrusts change over an interval as the reference's; else they are held")
    lines: LineWeights = part(LineWeights)
