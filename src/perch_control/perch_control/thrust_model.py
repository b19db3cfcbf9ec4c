"""Vehicle model used in flight: that of the vehicle file, with the thrust observed in flight."""

from __future__ import annotations

from math import hypot

from perch_control.admission import CONTACT_EARLY
from perch_control.flight_state import FlightState
from perch_control.l1 import L1Augmentation
from perch_control.law import Law
from perch_control.rotor_health import RATE_MAX, RotorHealth
from perch_control.rotor_lag import thrusts
from perch_core.vector3 import axes_of, scale
from perch_core.vehicle import Vehicle


class ThrustModel:
    """Owns the rotors' health, and passes the resulting vehicle model to flight state, law and augmentation.

    Attributes:
        health: health of the rotors.
        measured_specific_thrust: last measured specific force along b3 [m/s^2].
    """

    def __init__(self, vehicle: Vehicle) -> None:
        self._nominal, self.measured_specific_thrust = vehicle, 0.0
        self.health = RotorHealth(4.0 * vehicle.thrust_max / vehicle.hover_thrust)

    def reset(self, x: FlightState, law: Law, compensator: L1Augmentation | None) -> FlightState:
        """Return to the thrust of the vehicle file, as the rotors are started."""
        self.health.reset()
        return self._with_vehicle(x, law, compensator)

    def updated(self, x: FlightState, law: Law, compensator: L1Augmentation | None, fresh: bool) -> FlightState:
        """Compare measured and modelled thrust in free flight; adopt a weaker vehicle model where the rotors are found weak.

        `fresh`: whether `measured_specific_thrust` is up to date."""
        if not fresh or x.at_ground or x.may_touch(CONTACT_EARLY) or hypot(*x.state_estimate[10:13]) > RATE_MAX:
            self.health.pause(x.now)
        elif self.health.update(self.measured_specific_thrust, self._predicted_specific_thrust(x), x.now):
            if not x.weak:
                event = f"weak rotors: {100.0 * self.health.ratio:.0f} % of the commanded thrust is measured"
                x = x._replace(events=(*x.events, event))
            return self._with_vehicle(x, law, compensator)
        return x

    def ratio(self, compensator: L1Augmentation | None) -> float:
        """Thrust / mass that would be used for a contact, over the vehicle file's: the ratio that `adopted` would set."""
        return self.health.applied_ratio if compensator is None else self.health.adoptable

    def observed_vehicle(self, x: FlightState) -> Vehicle:
        """Vehicle model with the recently measured thrust, however close to the file's; with weak rotors, the model in use."""
        return x.vehicle if x.weak else self._nominal.with_thrust_ratio(self.health.plausible_mean)

    def adopted(self, x: FlightState, law: Law, compensator: L1Augmentation | None) -> FlightState:
        """Before a contact, attribute the error of thrust / mass that L1 compensates in hover to the thrust model.

        As a constant acceleration, the compensation would be wrong once the vehicle tilts and the thrust changes, which is too
        fast for any filter.
        """
        before = self.health.applied_ratio
        if compensator is None or not self.health.adopt():
            return x
        explained = (self.health.applied_ratio - before) * self._predicted_specific_thrust(x)
        x = self._with_vehicle(x, law, compensator, scale(explained, axes_of(x.state_estimate[6:10])[2]))
        return x._replace(events=(*x.events, f"thrust / mass is {100.0 * self.health.applied_ratio:.0f} % of the file's"))

    def _predicted_specific_thrust(self, x: FlightState) -> float:
        return sum(thrusts(x.rotors.speed, self._nominal.thrust_coefficient)) / self._nominal.mass

    def _with_vehicle(self, x: FlightState, law: Law, compensator: L1Augmentation | None,
                      explained: tuple[float, ...] | None = None) -> FlightState:
        vehicle = self._nominal.with_thrust_ratio(self.health.applied_ratio)
        law.set_vehicle(vehicle)
        if compensator is not None:
            compensator.set_vehicle(vehicle, explained)
        return x._replace(vehicle=vehicle, weak=self.health.weak)
