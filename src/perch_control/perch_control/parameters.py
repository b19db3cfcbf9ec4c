"""Parameters of the node `controller`."""

from __future__ import annotations

from dataclasses import dataclass

from perch_control.flight_settings import FlightSettings
from perch_control.l1 import L1Settings
from perch_control.laws import check_law
from perch_control.nmpc.settings import NmpcSettings
from perch_control.settings import GeometricGains
from perch_core.config import choice, part, quantity, text


@dataclass(frozen=True, kw_only=True)
class ControllerChoice:
    """Which control law flies."""

    type: str = text("geometric", doc="control law, one of perch_control.laws (geometric, nmpc); service set_controller changes it, too")
    adaptive: bool = quantity(False, doc="L1 augmentation on force and moment")
    standby: bool = quantity(True, doc="prepare laws that take long to build (nmpc), so that set_controller can choose them in flight")
    reference_period: float = quantity(0.01, unit="s", above=0.0, high=1.0, doc="of controller/reference")

    def __post_init__(self) -> None:
        check_law(self.type)


@dataclass(frozen=True, kw_only=True)
class ControllerParameters:
    """Parameters of the node `controller`: gain sets by vehicle, limits of the supervisor."""

    vehicle: str = text("snapdragon", doc="config/vehicles/<name>.yaml, or a file")
    gains: str = choice("vehicle", options=("vehicle", "snapdragon", "rpg"), doc="gain set; vehicle: the one whose name the vehicle's begins with")
    blind_after: float = quantity(0.08, unit="s", above=0.0, high=1.0,
                                  doc="without odometry for so long, descend on the IMU alone, by its stamps; without either, by the clock; "
                                      "motors stop after 0.1 s without commands")
    controller: ControllerChoice = part(ControllerChoice)
    snapdragon: GeometricGains = part(GeometricGains)
    rpg: GeometricGains = part(GeometricGains)
    nmpc: NmpcSettings = part(NmpcSettings)
    l1: L1Settings = part(L1Settings)
    flight: FlightSettings = part(FlightSettings)

    def gain_set(self, vehicle_name: str) -> GeometricGains:
        """The gains to fly a vehicle with; they are per unit of mass and inertia, so an unknown vehicle takes snapdragon's."""
        name = self.gains if self.gains != "vehicle" else vehicle_name
        return self.rpg if name.startswith("rpg") else self.snapdragon
