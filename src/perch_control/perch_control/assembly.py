"""The controller of a vehicle put together from its parameters: laws, augmentation and flight, and the choice among them."""

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
from perch_core.component import Job
from perch_core.errors import ConfigError, PerchError
from perch_core.lines import Segment
from perch_core.trajectory import FlatTrajectory, SampledTrajectory
from perch_core.values import AtEnd, TrajectoryOrder
from perch_core.vehicle import Vehicle


class LawNotReady(PerchError):
    """The law is not there: it is being built, was not asked for, or could not be built."""


def build_law(name: str, vehicle: Vehicle, params: ControllerParameters) -> Law:
    """A law by its name.

    Raises:
        PerchError: it cannot be built.
    """
    return law_class(name).build(vehicle, params)


class Assembly:
    """Owns the laws.

    Attributes:
        vehicle: as its file says.
        flight: the flight controller, flying the law and the augmentation that the parameters name.
        laws: those that are built, by name.
    """

    def __init__(self, params: ControllerParameters, vehicle: Vehicle) -> None:
        """
        Raises:
            ConfigError: there is no such law.
        """
        self._params, self.vehicle = params, vehicle
        self._failed: dict[str, tuple[str, Callable[[], None]]] = {}  # why, and how to try it again
        self._segments: Sequence[Segment] = ()
        choice = params.controller
        self.laws: dict[str, Law] = {choice.type: build_law(choice.type, vehicle, params)}
        self._begin(choice.type, choice.adaptive)

    def restart(self) -> None:
        """A new flight, on the ground, with the law that flies now."""
        self._begin(self.flown, self.flight.compensator is not None)

    def _begin(self, law: str, adaptive: bool) -> None:
        self.flight = FlightController(self.vehicle, self.laws[law], self._params.gain_set, self._params.flight)
        self.choose(law, adaptive)

    @property
    def flown(self) -> str:
        """Name of the law that flies."""
        return next(name for name, law in self.laws.items() if law is self.flight.law)

    # -- laws --------------------------------------------------------------------------------------------------------

    def prepare_slow_laws(self, work: Callable[[Job], None], say: Callable[[str], None]) -> None:
        """Build what takes long beside the flight.

        Args:
            work: takes the jobs.
            say: told what could not be built.
        """
        for name in LAWS:
            if name not in self.laws and law_class(name).slow:
                self._prepare(name, work, say)

    def _prepare(self, name: str, work: Callable[[Job], None], say: Callable[[str], None]) -> None:
        params = self._params
        work(Job(build_law, (name, self.vehicle, params), partial(self._prepared, name, params, work, say)))

    def _prepared(self, name: str, params: ControllerParameters, work: Callable[[Job], None], say: Callable[[str], None],
                  built: Law | Exception) -> None:
        law: Law | Exception | None = built
        if params is not self._params:  # gains were changed in the meantime
            try:
                law = None if isinstance(built, Exception) else built.retuned(self._params)
            except ConfigError:
                law = None
        if law is None:
            self._prepare(name, work, say)
            return
        if isinstance(law, Exception):
            self._failed[name] = str(law), partial(self._prepare, name, work, say)
            say(f"{name} could not be built: {law}")
            return
        self.laws[name] = law
        self._show_lines(law)

    def choose(self, type: str, adaptive: bool) -> None:
        """Fly a law, with or without L1, from the next step on.

        Raises:
            ConfigError: there is no such law.
            LawNotReady: it takes long to build, and has not been built.
        """
        if type not in self.laws:
            if law_class(type).slow:
                raise LawNotReady(self._absent(type))
            self.laws[type] = build_law(type, self.vehicle, self._params)
        flight = self.flight
        if not adaptive:
            flight.compensator = None
        elif flight.compensator is None:
            flight.compensator = L1Augmentation(flight.vehicle, self._params.controller.l1_bandwidth)
        flight.use(self.laws[type], self._params.gain_set, self._params.flight)

    def change(self, params: ControllerParameters) -> None:
        """New gains and limits from the next step on; another law or augmentation where these differ.

        Raises:
            ConfigError: one that is fixed after the start has changed, or the law is not ready; all stays as it was.
        """
        flight, old = self.flight, self._params
        choice, flown = params.controller, self.flown
        if choice.type != old.controller.type and choice.type not in self.laws and law_class(choice.type).slow:
            raise ConfigError("", "controller.type", self._absent(choice.type))
        changed = {name: law.retuned(params) for name, law in self.laws.items()}
        if changed[flown] is None:
            changed[flown] = build_law(flown, self.vehicle, params)
        self._params = params
        self.laws = {name: law for name, law in changed.items() if law is not None}
        if flight.compensator is not None:
            flight.compensator.bandwidth = choice.l1_bandwidth
        # What the service has chosen stays where the parameter has not changed.
        adaptive = flight.compensator is not None
        self.choose(choice.type if choice.type != old.controller.type else flown,
                    choice.adaptive if choice.adaptive != old.controller.adaptive else adaptive)
        failed, self._failed = self._failed, {}
        for _, again in failed.values():
            again()

    def _absent(self, name: str) -> str:
        """Why a law that takes long to build is not there."""
        return f"{name} could not be built: {self._failed[name][0]}" if name in self._failed else f"{name} is not ready: it is being built"

    # -- what is flown -----------------------------------------------------------------------------------------------

    def reference(self, trajectory: FlatTrajectory | SampledTrajectory) -> FlatReference | SampledReference:
        """A trajectory as the laws take it."""
        if isinstance(trajectory, FlatTrajectory):
            return FlatReference(trajectory)
        return SampledReference(with_unit_quaternions(trajectory), self.vehicle.mass)

    def order(self, order: TrajectoryOrder) -> Order:
        """An order as the flight takes it.

        Raises:
            TrajectoryRefused: it makes no sense.
        """
        check_order(order, self.vehicle)
        trajectory = order.trajectory
        return Order(order.id, self.reference(trajectory), trajectory.start_time, AtEnd(order.at_end), float(order.contact_time),
                     float(order.recovery_start))

    def see(self, segments: Sequence[Segment]) -> None:
        """The map of powerlines, for laws that look at them."""
        self._segments = segments
        for law in self.laws.values():
            self._show_lines(law)

    def _show_lines(self, law: Law) -> None:
        belief = self.flight.flown.belief
        if self._params.nmpc.lines.any and belief:
            law.lines(chosen_lines(self._segments, np.array(belief[0:3]), self._params.nmpc.lines.watched))
