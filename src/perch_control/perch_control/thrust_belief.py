"""Which vehicle is flown: the one of the file, with the thrust that it has shown in the air."""

from __future__ import annotations

from dataclasses import replace
from math import hypot
from typing import Any

from perch_control.maneuvers import Maneuvers
from perch_control.rotor_health import RATE_MOST, RotorHealth
from perch_control.rotor_lag import thrusts
from perch_core.vector3 import axes_of, scale
from perch_core.vehicle import Vehicle

AIRBORNE = 0.1    # so far above where it was armed, the ground no longer carries the vehicle [m]
_TOUCHING = 0.1   # from so long before a planned contact on, a surface or a wire may act on the vehicle [s]


class ThrustBelief:
    """Owns the rotors' health, and gives manoeuvres, law and augmentation the vehicle that follows from it.

    Attributes:
        health: of the rotors.
        felt: specific force along b3, as measured last [m/s^2].
        vehicle: as believed.
    """

    def __init__(self, vehicle: Vehicle, maneuvers: Maneuvers) -> None:
        self._nominal, self._maneuvers = vehicle, maneuvers
        self.health = RotorHealth(4.0 * vehicle.thrust_max / vehicle.hover_thrust)
        self.vehicle, self.felt = vehicle, 0.0

    def reset(self, law: Any, compensator: Any) -> None:
        """The rotors are started: they are as the file says until they show otherwise."""
        self.health.reset()
        self._tell(law, compensator)

    def judge(self, law: Any, compensator: Any) -> None:
        """Compare felt and promised thrust in free air; weak rotors are a weaker vehicle from now on."""
        m = self._maneuvers
        if m.belief[2] - m.ground < AIRBORNE or m.may_touch(_TOUCHING) or hypot(*m.belief[10:13]) > RATE_MOST:
            self.health.pause(m.now)
        elif self.health.update(self.felt, self._promised(), m.now):
            if not m.weak:
                m.events.append(f"weak rotors: {100.0 * self.health.ratio:.0f} % of the thrust that was commanded is felt")
            self._tell(law, compensator)

    def adopt(self, law: Any, compensator: Any) -> None:
        """Before a contact: what L1 makes up for in hover because thrust / mass is not the file's belongs to the thrust.

        As an acceleration it would be wrong as soon as the vehicle tilts and the thrust changes, and too fast for any filter.
        """
        m, before = self._maneuvers, self.health.believed
        if self.health.adopt():
            explained = (self.health.believed - before) * self._promised()
            self._tell(law, compensator, scale(explained, axes_of(m.belief[6:10])[2]))
            m.events.append(f"thrust / mass is {100.0 * self.health.believed:.0f} % of the file's")

    def _promised(self) -> float:
        return sum(thrusts(self._maneuvers.rotors.speed, self._nominal.thrust_coefficient)) / self._nominal.mass

    def _tell(self, law: Any, compensator: Any, explained: tuple[float, ...] | None = None) -> None:
        m, nominal = self._maneuvers, self._nominal
        self.vehicle = m.vehicle = replace(nominal, thrust_coefficient=self.health.believed * nominal.thrust_coefficient)
        m.weak = self.health.weak
        law.believe(self.vehicle)
        if compensator is not None:
            compensator.believe(self.vehicle, explained)
