"""Assembly of a vehicle's controller from its parameters: laws, augmentation and flight controller, and the choice of the law."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from perch_control.admission import Order, check_order
from perch_control.flight import FlightController
from perch_control.l1 import L1Augmentation
from perch_control.law import Law
from perch_control.laws import LAWS, law_class
from perch_control.nmpc import chosen_lines
from perch_control.parameters import ControllerParameters
from perch_control.reference import FlatReference, SampledReference, with_unit_quaternions
from perch_core.errors import ConfigError, PerchError
from perch_core.job import Job
from perch_core.lines import Segment
from perch_core.trajectory import FlatTrajectory, SampledTrajectory
from perch_core.values import AtEnd, TrajectoryOrder
from perch_core.vehicle import Vehicle


class LawNotReady(PerchError):
    """Raised when a law is not available: it is still being built, or could not be built."""


def build_law(name: str, vehicle: Vehicle, params: ControllerParameters) -> Law:
    """Build a law by its name.

    Raises:
        PerchError: the law cannot be built.
    """
    return law_class(name).build(vehicle, params)


class Assembly:
    """Owns the control laws and the flight controller.

    Attributes:
        vehicle: the vehicle of the vehicle file.
        flight: the flight controller, with the chosen law and augmentation.
        laws: laws that have been built, by name.
    """

    def __init__(self, params: ControllerParameters, vehicle: Vehicle) -> None:
        """
        Raises:
            ConfigError: there is no such law.
        """
        self._params, self.vehicle = params, vehicle
        self._work: Callable[[Job], None] | None = None  # None: no slow law is prepared yet
        self._log: Callable[[str], None]
        self._failed: dict[str, str] = {}  # slow law that could not be built -> why
        self._segments: Sequence[Segment] = ()
        choice = params.controller
        self.laws: dict[str, Law] = {choice.type: build_law(choice.type, vehicle, params)}
        self._begin(choice.type, choice.adaptive)

    def restart(self) -> None:
        """Begin a new flight, disarmed, with the law in use, and without lines near the vehicle until its place is known."""
        for law in self.laws.values():
            law.lines(())
        self._begin(self.active_law, self.flight.compensator is not None)

    def _begin(self, law: str, adaptive: bool) -> None:
        self.flight = FlightController(self.vehicle, self.laws[law], self._params.gain_set, self._params.flight)
        self.choose(law, adaptive)

    @property
    def active_law(self) -> str:
        """Name of the law in use."""
        return next(name for name, law in self.laws.items() if law is self.flight.law)

    # -- laws --------------------------------------------------------------------------------------------------------

    def prepare_slow_laws(self, work: Callable[[Job], None], log: Callable[[str], None]) -> None:
        """Build the slow laws in the background.

        Args:
            work: runs a job in the background.
            log: logs which law could not be built.
        """
        self._work, self._log = work, log
        for name in LAWS:
            if name not in self.laws and law_class(name).slow:
                self._prepare(name)

    def _prepare(self, name: str) -> None:
        if self._work is not None:
            self._work(Job(build_law, (name, self.vehicle, self._params), partial(self._prepared, name, self._params)))

    def _prepared(self, name: str, params: ControllerParameters, built: Law | Exception) -> None:
        law: Law | Exception | None = built
        if params is not self._params:  # gains were changed in the meantime
            try:
                law = None if isinstance(built, Exception) else built.retuned(self._params)
            except ConfigError:
                law = None
        if law is None:
            self._prepare(name)
            return
        if isinstance(law, Exception):
            self._failed[name] = str(law)
            self._log(f"{name} could not be built: {law}")
            return
        self.laws[name] = law
        self._update_lines(law)

    def choose(self, type: str, adaptive: bool) -> None:
        """Use a law, with or without L1, from the next step on.

        Raises:
            ConfigError: there is no such law.
            LawNotReady: the law is slow to build, and has not been built.
        """
        if type not in self.laws:
            if law_class(type).slow:
                raise LawNotReady(self._not_ready_reason(type))
            self.laws[type] = build_law(type, self.vehicle, self._params)
        flight = self.flight
        if not adaptive:
            flight.compensator = None
        elif flight.compensator is None:
            flight.compensator = L1Augmentation(flight.vehicle, self._params.controller.l1_bandwidth)
        flight.use(self.laws[type], self._params.gain_set, self._params.flight)

    def change(self, params: ControllerParameters) -> None:
        """Use new gains and limits from the next step on, and another law or augmentation where these have changed.

        Raises:
            ConfigError: a parameter that is fixed after the start has changed, or the law is not ready, or would take long to be
                built again in flight; nothing is changed.
        """
        flight, old, choice = self.flight, self._params, params.controller
        chosen = choice.type if choice.type != old.controller.type else self.active_law  # what the service has chosen stays otherwise
        slow = law_class(chosen).slow
        if chosen not in self.laws and slow:
            raise ConfigError("", "controller.type", self._not_ready_reason(chosen))
        law = self.laws[chosen].retuned(params) if chosen in self.laws else None
        if law is None:
            if slow and flight.flight_state.flying:
                raise ConfigError("", "controller.type", f"{chosen} takes long to be built with other parameters: not in flight")
            law = build_law(chosen, self.vehicle, params)
        changed = {chosen: law} | {name: other.retuned(params) for name, other in self.laws.items() if name != chosen}
        self._params = params
        self.laws = {name: law for name, law in changed.items() if law is not None}
        if flight.compensator is not None:
            flight.compensator.bandwidth = choice.l1_bandwidth
        adaptive = flight.compensator is not None
        self.choose(chosen, choice.adaptive if choice.adaptive != old.controller.adaptive else adaptive)
        dropped = [name for name, law in changed.items() if law is None and law_class(name).slow]
        failed, self._failed = self._failed, {}
        for name in (*dropped, *failed):
            self._prepare(name)

    def _not_ready_reason(self, name: str) -> str:
        """Return why a slow law is not available."""
        return f"{name} could not be built: {self._failed[name]}" if name in self._failed else f"{name} is not ready: it is being built"

    # -- references and lines ----------------------------------------------------------------------------------------

    def reference(self, trajectory: FlatTrajectory | SampledTrajectory) -> FlatReference | SampledReference:
        """Return a trajectory as a reference for the laws."""
        if isinstance(trajectory, FlatTrajectory):
            return FlatReference(trajectory)
        return SampledReference(with_unit_quaternions(trajectory), self.vehicle.mass)

    def order(self, order: TrajectoryOrder) -> Order:
        """Check an order, and return it in the form of the flight controller.

        Raises:
            TrajectoryRefused: the order is invalid.
        """
        check_order(order, self.vehicle)
        trajectory = order.trajectory
        return Order(order.id, self.reference(trajectory), trajectory.start_time, AtEnd(order.at_end), float(order.contact_time),
                     float(order.recovery_start))

    def set_lines(self, segments: Sequence[Segment]) -> None:
        """Take the map of powerlines."""
        self._segments = segments
        self.choose_lines()

    def choose_lines(self) -> None:
        """Pass the lines of the map that are near the vehicle now to the laws that use them."""
        self._update_lines(*self.laws.values())

    def _update_lines(self, *laws: Law) -> None:
        state = self.flight.flight_state.state_estimate
        if self._params.nmpc.lines.any and state:
            chosen = chosen_lines(self._segments, np.array(state[0:3]), self._params.nmpc.lines.watched)
            for law in laws:
                law.lines(chosen)
