"""Parameters of the node `controller`."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any

from perch_control.flight_settings import FlightSettings
from perch_control.laws import check_law
from perch_control.nmpc.settings import NmpcSettings
from perch_core.arrays import Vector3
from perch_core.config import part, quantity, text
from perch_core.errors import ConfigError
from perch_core.imu_axes import IMU_AXES
from perch_core.vehicle import ControlGains, load_vehicle


@dataclass(frozen=True, kw_only=True)
class ControllerChoice:
    """Choice of the control law."""

    type: str = text("geometric", doc="control law, one of perch_control.laws (geometric, nmpc); service set_controller changes it, too")
    adaptive: bool = quantity(True, doc="L1 augmentation on force and moment")
    l1_bandwidth: float = quantity(15.0, unit="rad/s", above=0.0, high=100.0, doc="bandwidth of the L1 compensation, force and moment")
    reference_period: float = quantity(0.01, unit="s", above=0.0, high=1.0, doc="of controller/reference")

    def __post_init__(self) -> None:
        check_law(self.type)


def _of_vehicle(name: str) -> Any:
    """Return a parameter with unit and range of the vehicle file's gain; where it is not set, it has the vehicle file's value."""
    meta = next(item for item in fields(ControlGains) if item.name == name).metadata
    return field(default=None, metadata={**meta, "doc": f"{meta['doc']}; not set: the vehicle file's"})


@dataclass(frozen=True, kw_only=True)
class GainParameters:
    """Gains that replace those of the vehicle file; see `ControlGains`."""

    position: Vector3 | None = _of_vehicle("position")
    velocity: Vector3 | None = _of_vehicle("velocity")
    attitude: Vector3 | None = _of_vehicle("attitude")
    rate: Vector3 | None = _of_vehicle("rate")
    lead: float | None = _of_vehicle("lead")


@dataclass(frozen=True, kw_only=True)
class ControllerParameters:
    """Parameters of the node `controller`. Gains that are not set are filled in from the vehicle file, for `ros2 param get`."""

    vehicle: str = text("snapdragon", doc="config/vehicles/<name>.yaml, or a file")
    sensors: str = text("", doc=IMU_AXES)
    controller: ControllerChoice = part(ControllerChoice)
    gains: GainParameters = part(GainParameters)
    nmpc: NmpcSettings = part(NmpcSettings)
    flight: FlightSettings = part(FlightSettings)

    def __post_init__(self) -> None:
        given = {name: value for name, value in vars(self.gains).items() if value is not None}
        if len(given) == len(fields(GainParameters)):
            return
        try:
            gains = load_vehicle(self.vehicle).gains
        except ConfigError as error:
            raise ConfigError("", "vehicle", str(error)) from None
        object.__setattr__(self, "gains", GainParameters(**{**vars(gains), **given}))

    @property
    def gain_set(self) -> ControlGains:
        """The gains in use."""
        return ControlGains(**vars(self.gains))
