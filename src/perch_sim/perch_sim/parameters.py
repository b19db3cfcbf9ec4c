"""Parameters of the node `vehicle`."""

from __future__ import annotations

from dataclasses import dataclass

from perch_core.config import choice, quantity, text
from perch_core.errors import ConfigError
from perch_sim.lockstep.tasks import PARTICIPANTS

CAMERAS = {"all": ("down", "front"), "down": ("down",), "front": ("front",), "none": ()}


@dataclass(frozen=True, kw_only=True)
class VehicleParameters:
    """Parameters of the node `vehicle`; all are read once, at the start."""

    scenario: str = text("surface_90", doc="config/scenarios/<name>.yaml, or a file")
    vehicle: str = text("", doc="config/vehicles/<name>.yaml, or a file; empty: the scenario's")
    seed: int = quantity(1, low=0, high=2**31 - 1, doc="of everything that is random")
    participants: tuple[str, ...] = text(
        ("controller",), doc="nodes that the lockstep waits for: " + ", ".join(PARTICIPANTS) + "; an empty name: none")
    lockstep_timeout: float = quantity(60.0, unit="s", above=0.0, high=3600.0,
                                       doc="wall-clock time after which a silent participant is dropped, and one that never came, then at least 60 s")
    cameras: str = choice("all", options=tuple(CAMERAS), doc="cameras that take images; all: those that the vehicle has; none: for fast runs")

    def __post_init__(self) -> None:
        for name in self.participants:
            if name and name not in PARTICIPANTS:
                raise ConfigError("", "participants", f"{name!r} is not one of {', '.join(PARTICIPANTS)}")
