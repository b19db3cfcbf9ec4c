"""Parameters of the node `controller`."""

from __future__ import annotations

from dataclasses import dataclass

from perch_control.flight_settings import FlightSettings
from perch_control.l1 import L1Settings
from perch_control.nmpc.settings import NmpcSettings
from perch_control.settings import GeometricGains
from perch_core.config import choice, part, quantity, text


@dataclass(frozen=True, kw_only=True)
class ControllerChoice:
    """Which control law flies."""

    type: str = choice("geometric", options=("geometric", "nmpc"), doc="control law at the start; service set_controller changes it")
    adaptive: bool = quantity(False, doc="L1 augmentation on force and moment")
    standby: bool = quantity(True, doc="prepare the NMPC in the background, so that set_controller can choose it in flight")
    reference_period: int = quantity(5, low=1, high=500, doc="controller/reference every so many steps")


@dataclass(frozen=True, kw_only=True)
class ControllerParameters:
    """Parameters of the node `controller`: gain sets by vehicle, limits of the supervisor."""

    vehicle: str = text("snapdragon", doc="config/vehicles/<name>.yaml, or a file")
    gains: str = choice("vehicle", options=("vehicle", "snapdragon", "rpg"), doc="gain set; vehicle: the one whose name the vehicle's begins with")
    estimator_status: bool = quantity(True, doc="estimator/status is awaited at every 50th step; false: there is no estimator that sends it")
    blind_after: float = quantity(0.08, unit="s", above=0.0,
                                  doc="real time: without odometry for so long while the IMU goes on, descend on the IMU alone; "
                                      "motors stop after 0.1 s without commands")
    blind_after_lockstep: float = quantity(10.0, unit="s", above=0.0, doc="the same in lockstep, wall-clock time: a slow estimator is not a dead one")
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
