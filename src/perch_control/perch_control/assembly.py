"""The controller of a vehicle put together from its parameters: laws, augmentation and flight, and the choice among them."""

from __future__ import annotations

from perch_control.flight import FlightController
from perch_control.geometric import GeometricController
from perch_control.l1 import L1Augmentation
from perch_control.nmpc import NmpcController
from perch_control.parameters import ControllerParameters
from perch_control.reference import FlatReference, SampledReference
from perch_core.errors import ConfigError, PerchError
from perch_core.trajectory import FlatTrajectory, SampledTrajectory
from perch_core.vehicle import Vehicle


class LawNotReady(PerchError):
    """The law is not there: it is being compiled, or was not asked for."""


class Assembly:
    """Owns the laws.

    Attributes:
        vehicle: as its file says.
        flight: the flight controller, flying the law and the augmentation that the parameters name.
        nmpc: the predictive controller, None where it was not built (yet).
    """

    def __init__(self, params: ControllerParameters, vehicle: Vehicle) -> None:
        self._params, self.vehicle = params, vehicle
        gains = params.gain_set(vehicle.name)
        self._geometric = GeometricController(vehicle, gains)
        self.nmpc: NmpcController | None = None
        self.flight = FlightController(vehicle, self._geometric, gains, params.flight)
        if params.controller.type == "nmpc":
            self.build_nmpc()
        self.choose(params.controller.type, params.controller.adaptive)

    def build_nmpc(self) -> None:
        """Compile the predictive controller, or find it compiled; seconds the first time, a tenth of one later."""
        self.nmpc = NmpcController(self.vehicle, self._params.nmpc, self._geometric)

    def choose(self, type: str, adaptive: bool) -> None:
        """Fly a law (geometric, nmpc), with or without L1, from the next step on.

        Raises:
            ConfigError: there is no such law.
            LawNotReady: the NMPC has not been built.
        """
        laws = {"geometric": self._geometric, "nmpc": self.nmpc}
        if type not in laws:
            raise ConfigError("", "type", f"{type!r} is not one of {', '.join(laws)}")
        if laws[type] is None:
            raise LawNotReady("nmpc is not ready: it is being compiled, or controller.standby is false")
        flight = self.flight
        if not adaptive:
            flight.compensator = None
        elif flight.compensator is None:
            flight.compensator = L1Augmentation(flight.vehicle, self._params.l1)
        flight.use(laws[type], self._params.gain_set(self.vehicle.name), self._params.flight)

    def change(self, params: ControllerParameters) -> None:
        """New gains and limits from the next step on.

        Raises:
            ConfigError: one that is fixed after the start has changed.
        """
        gains, flight = params.gain_set(self.vehicle.name), self.flight
        geometric = GeometricController(self.vehicle, gains)
        if self.nmpc is not None:
            self.nmpc.retune(params.nmpc, geometric)
        if flight.compensator is not None:
            flight.compensator.settings = params.l1
        law = self.nmpc if flight.law is self.nmpc else geometric
        self._params, self._geometric = params, geometric
        flight.use(law, gains, params.flight)

    def reference(self, trajectory: FlatTrajectory | SampledTrajectory) -> FlatReference | SampledReference:
        """A trajectory as the laws take it."""
        return FlatReference(trajectory) if isinstance(trajectory, FlatTrajectory) else SampledReference(trajectory, self.vehicle.mass)
