"""Weights, limits and horizon of the predictive controller."""

from __future__ import annotations

from dataclasses import dataclass

from perch_core.config import part, quantity
from perch_core.errors import ConfigError

Vector3 = tuple[float, float, float]


@dataclass(frozen=True)
class LineWeights:
    """Soft terms for powerlines; they ramp up from zero. [P:VI-A]"""

    perception: float = quantity(0.0, low=0.0, doc="reprojection error of the first line [P:eq9]")
    visibility: float = quantity(0.0, low=0.0, doc="cheirality and segment visibility of the first line [P:eq12, P:eq13]")
    collision: float = quantity(0.0, low=0.0, doc="clearance from every line [P:eq7]")
    margin: float = quantity(0.3, unit="-", low=0.0, doc="scaled clearance below which the collision term acts")
    ramp_time: float = quantity(3.0, unit="s", low=0.0, doc="the terms grow to their weights over this time")
    watched: tuple[float, ...] = quantity((), unit="m", doc="rough point in map on the line to keep in view (x, y, z); empty: the nearest line")

    def __post_init__(self) -> None:
        if len(self.watched) not in (0, 3):
            raise ConfigError("", "watched", f"has {len(self.watched)} entries, needs 3 (x, y, z), or none")

    @property
    def any(self) -> bool:
        """Some term is wanted."""
        return self.perception > 0.0 or self.visibility > 0.0 or self.collision > 0.0


@dataclass(frozen=True)
class NmpcSettings:
    """Horizon, weights (diagonals of the quadratic cost) and limits."""

    nodes: int = quantity(20, low=5, high=60, doc="shooting intervals N")
    horizon: float = quantity(1.0, unit="s", above=0.05, high=5.0)
    thrust_states: bool = quantity(False, doc="17 states: rotor thrusts are states, their rates the inputs")
    position: Vector3 = quantity((200.0, 200.0, 300.0), unit="1/m^2", low=0.0, doc="axes of W")
    velocity: Vector3 = quantity((8.0, 8.0, 10.0), unit="s^2/m^2", low=0.0, doc="axes of W")
    attitude: Vector3 = quantity((12.0, 12.0, 4.0), unit="1/rad^2", low=0.0, doc="axes of B")
    rate: Vector3 = quantity((0.08, 0.08, 0.1), unit="s^2/rad^2", low=0.0, doc="axes of B")
    thrust: float = quantity(1.0, unit="1/N^2", above=0.0, doc="distance of the rotor thrusts from the reference's")
    thrust_rate: float = quantity(0.002, unit="s^2/N^2", above=0.0, doc="rates of the rotor thrusts, 17 states alone")
    terminal: float = quantity(4.0, above=0.0, doc="factor of the state weights at the last node")
    rate_max: float = quantity(0.0, unit="rad/s", low=0.0, doc="soft limit of each body rate; 0: 1.2 times the vehicle's body_rate_max")
    thrust_rate_max: float = quantity(0.0, unit="N/s", low=0.0, doc="limit of the thrust rates; 0: the vehicle's, or what its rotor lag allows in hover")
    lead: float = quantity(0.02, unit="s", low=0.002, high=0.2, doc="time in which the rotors reach the wanted thrust")
    ramps: bool = quantity(False, doc="thrusts change over an interval as the reference's, and are sent as early as led rotors are late; "
                                      "else they are held, and sent `lead` early")
    lines: LineWeights = part(LineWeights)
