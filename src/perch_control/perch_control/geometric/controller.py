"""The geometric controller as an object without hidden state: vehicle and gains in, one call per control period."""

from __future__ import annotations

from math import radians, tan
from typing import TYPE_CHECKING

import numpy as np

from perch_control.allocation import mixing_columns
from perch_control.geometric.rehearsal import flown, rehearsed
from perch_control.geometric.step import control_step
from perch_control.guidance import Running
from perch_control.law import NO_COMPENSATION, ControlOutput, Law
from perch_control.reference import Following
from perch_control.rotor_lag import RotorEstimate
from perch_core.vehicle import ControlGains, Vehicle

if TYPE_CHECKING:
    from perch_control.parameters import ControllerParameters

RATE_RESERVE = 1.3        # commanded rates may exceed what a plan may ask for by this factor, so that feedback has room
FEEDBACK_MAX = 8.0        # bound of the position feedback: what the weakest vehicle here has beside its weight [m/s^2]
CONE_DEG = 40.0           # the feedback turns the thrust no further from the reference's: it cannot turn the vehicle over [deg]
CONE_CONTACT_DEG = 5.0    # the same at a contact: at its thrust 10 cm of error would tilt the vehicle by 12 deg [deg]
CONTACT_WINDOW = 0.3      # before the contact, over which the cone narrows to that: the thrust is low by then [s]
THRUST_FLOOR = 0.8        # specific thrust below which a direction is noise [m/s^2]
ACCELERATION_MAX = 250.0  # bound of the commanded angular acceleration: what the rotors of snapdragon.yaml can do [rad/s^2]
FEEDBACK_RATE = 0.0       # share of the feedback's own derivative in the commanded rates: an estimated velocity is too noisy for it


def packed_vehicle(vehicle: Vehicle) -> tuple:
    """The vehicle's constants as nested tuples of floats, as `control_step` takes them."""
    forward = tuple(tuple(float(v) for v in row) for row in vehicle.allocation[1:])
    return (
        (float(vehicle.mass), *(float(j) for j in vehicle.inertia)),
        (float(vehicle.thrust_coefficient), float(vehicle.speed_min), float(vehicle.speed_max),
         float(vehicle.motor_time_constant)),
        forward,
        mixing_columns(vehicle),
        tuple(float(d) / vehicle.mass for d in vehicle.drag),
    )


class GeometricController(Law):
    """Geometric tracking on SE(3) with rotor lead and prioritised saturation. [M:eq2]"""

    name = "geometric"

    def __init__(self, vehicle: Vehicle, gains: ControlGains) -> None:
        super().__init__(vehicle)
        self.gains = gains
        self._vehicle = packed_vehicle(vehicle)
        self._gains = (*gains.position, *gains.velocity, *gains.attitude, *gains.rate)
        self._wide, self._narrow = tan(radians(CONE_DEG)), tan(radians(CONE_CONTACT_DEG))
        self._rate_max = RATE_RESERVE * vehicle.body_rate_max
        self.step((0.0,) * 9 + (1.0, 0.0, 0.0, 0.0), (0.0,) * 16 + (1.0,) + (0.0,) * 16, RotorEstimate.at_idle(vehicle))

    @classmethod
    def build(cls, vehicle: Vehicle, params: ControllerParameters) -> GeometricController:
        """With the gains of the parameters."""
        return cls(vehicle, params.gain_set)

    @property
    def lead(self) -> float:
        """The reference is wanted this far ahead of the state [s]."""
        return self.gains.lead

    def control(self, state: tuple[float, ...], reference: Following, rotors: RotorEstimate,
                compensation: tuple[float, ...] = NO_COMPENSATION, time_to_contact: float = np.inf) -> ControlOutput:
        """As `step`, with the running reference."""
        return self.step(state, reference.setpoint(self.gains.lead).packed, rotors, compensation, time_to_contact)

    def step(self, state: tuple[float, ...], reference: tuple[float, ...], rotors: RotorEstimate,
             compensation: tuple[float, ...] = NO_COMPENSATION, time_to_contact: float = np.inf) -> ControlOutput:
        """Rotor commands for one period.

        Args:
            state: p_WB [m], v_WB [m/s] in W, q_WB xyzw, w_WB_B [rad/s], 13 floats.
            reference: setpoint `lead` seconds from now, 33 floats (see `Setpoint.packed`).
            rotors: rotor speeds and what they are following.
            compensation: acceleration in W and angular acceleration in B that make up for disturbances, 6 floats.
            time_to_contact: [s]; near zero position feedback gives way to attitude.
        """
        share = min(max(time_to_contact / CONTACT_WINDOW, 0.0), 1.0)
        cone = self._narrow + share * (self._wide - self._narrow)
        out = control_step(state, reference, rotors.speed, rotors.command, compensation, self._gains, self._limits(cone),
                           self.gains.lead, self._vehicle)
        return ControlOutput(*out[:6])

    def _limits(self, cone: float) -> tuple[float, ...]:
        return (FEEDBACK_MAX, cone, THRUST_FLOOR, self._rate_max, ACCELERATION_MAX, FEEDBACK_RATE)

    def believe(self, vehicle: Vehicle) -> None:
        """Fly a vehicle that differs from the one at the start in its thrust."""
        self.vehicle, self._vehicle = vehicle, packed_vehicle(vehicle)

    def prepare(self, source, contact: bool, running: Running | None = None):
        """The reference to follow for a trajectory: one that ends in contact is rehearsed and offset first.

        Args:
            source: the trajectory.
            contact: it ends in a contact.
            running: reference from which it takes over; None: the vehicle is where the trajectory begins.
        """
        gains = self.gains
        if not (contact and gains.contact_speed):
            return source
        return rehearsed(source, self.vehicle, self, gains.contact_speed, gains.contact_overshoot, running)

    def rehearse(self, start: np.ndarray, rotors: RotorEstimate, table: np.ndarray, period: float,
                 duration: float) -> np.ndarray:
        """State in which this controller ends a contact trajectory on the nominal vehicle.

        Args:
            start: state at the beginning, shape (13,).
            rotors: rotors at the beginning.
            table: setpoints `lead` ahead of each period, shape (n, 33).
            period: control period [s].
            duration: time from the beginning to the contact [s].

        Returns:
            State at `duration`, shape (13,).
        """
        return flown(tuple(start.tolist()), rotors.speed, table, self._gains, self._limits(self._wide), self._narrow,
                     CONTACT_WINDOW, self.gains.lead, period, duration, self._vehicle)
