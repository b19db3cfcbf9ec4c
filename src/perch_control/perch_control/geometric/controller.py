"""Geometric controller as an object without hidden state: built from vehicle and gains, called once per control period."""

from __future__ import annotations

from math import radians, tan
from typing import TYPE_CHECKING

import numpy as np

from perch_control.admission import TrajectoryRefused
from perch_control.allocation import mixing_columns
from perch_control.geometric.contact_check import contact_error, simulate
from perch_control.geometric.law import cone_before_contact
from perch_control.geometric.step import control_step
from perch_control.law import NO_COMPENSATION, ControlOutput, Law
from perch_control.reference import Following, Source
from perch_control.rotor_lag import RotorEstimate, lag_behind
from perch_core.vehicle import ControlGains, Vehicle

if TYPE_CHECKING:
    from perch_control.parameters import ControllerParameters

RATE_RESERVE = 1.3        # commanded rates may exceed what a plan may ask for by this factor, so that feedback has room
FEEDBACK_MAX = 8.0        # bound of the position feedback: what the weakest vehicle here has beside its weight [m/s^2]
CONE_DEG = 40.0           # the feedback turns the thrust no further from the reference's: it cannot turn the vehicle over [deg]
SETTLING = 2.0            # time constants of the tilt before a contact in which the feedback no longer turns the thrust
CONTACT_MISS = 0.02       # a contact trajectory is refused where the law misses its end by more on the model [m]
CONTACT_SPEED_MISS = 0.05  # the same for the velocity [m/s]
THRUST_FLOOR = 0.8        # specific thrust below which a direction is noise [m/s^2]
ACCELERATION_MAX = 250.0  # bound of the commanded angular acceleration: what the rotors of snapdragon.yaml can do [rad/s^2]


def packed_vehicle(vehicle: Vehicle) -> tuple:
    """Return the vehicle's constants as nested tuples of floats, in the form of `control_step`."""
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
    """Geometric tracking on SE(3) with rotor lead and prioritised saturation. [M:eq2]

    Attributes:
        lag: lag of the rotors behind their wanted speeds; state and reference are evaluated this far ahead [s].
    """

    name = "geometric"

    def __init__(self, vehicle: Vehicle, gains: ControlGains) -> None:
        super().__init__(vehicle)
        self.gains = gains
        self._vehicle = packed_vehicle(vehicle)
        self._gains = (*gains.position, *gains.velocity, *gains.attitude, *gains.rate)
        self._cone = tan(radians(CONE_DEG))
        self._settling = SETTLING * 2.0 / min(gains.rate[:2])  # an error of the tilt decays as exp(-rate t / 2)
        self._rate_max = RATE_RESERVE * vehicle.body_rate_max
        self.set_period(self.period)
        self.step((0.0,) * 9 + (1.0, 0.0, 0.0, 0.0), (0.0,) * 16 + (1.0,) + (0.0,) * 16, RotorEstimate.at_idle(vehicle))

    @classmethod
    def build(cls, vehicle: Vehicle, params: ControllerParameters) -> GeometricController:
        """Build the law with the gains of the parameters."""
        return cls(vehicle, params.gain_set)

    def control(self, state: tuple[float, ...], reference: Following, rotors: RotorEstimate,
                compensation: tuple[float, ...] = NO_COMPENSATION, time_to_contact: float = np.inf) -> ControlOutput:
        """As `step`, with the running reference."""
        return self.step(state, reference.setpoint(self.lag).packed, rotors, compensation, time_to_contact)

    def step(self, state: tuple[float, ...], reference: tuple[float, ...], rotors: RotorEstimate,
             compensation: tuple[float, ...] = NO_COMPENSATION, time_to_contact: float = np.inf) -> ControlOutput:
        """Rotor commands for one period.

        Args:
            state: p_WB [m], v_WB [m/s] in W, q_WB xyzw, w_WB_B [rad/s], 13 floats.
            reference: setpoint `lag` seconds from now, 33 floats (see `Setpoint.packed`).
            rotors: rotor speeds and their commands.
            compensation: acceleration in W and angular acceleration in B that compensate for disturbances, 6 floats.
            time_to_contact: [s]; in the last moments the feedback does not turn the thrust.
        """
        cone = cone_before_contact(time_to_contact, self._cone, self._settling)
        out = control_step(state, reference, rotors.speed, rotors.command, compensation, self._gains, self._limits(cone),
                           self.gains.lead, self.lag, self._vehicle)
        return ControlOutput(*out)

    def _limits(self, cone: float) -> tuple[float, ...]:
        return (FEEDBACK_MAX, cone, THRUST_FLOOR, self._rate_max, ACCELERATION_MAX)

    def set_period(self, period: float) -> None:
        """As in the base class."""
        self.period, self.lag = period, lag_behind(self.vehicle.motor_time_constant, self.gains.lead, period)

    def set_vehicle(self, vehicle: Vehicle) -> None:
        """Use a vehicle model that differs from the initial one in its thrust."""
        self.vehicle, self._vehicle = vehicle, packed_vehicle(vehicle)

    def check_contact(self, source: Source) -> None:
        """As `Law.check_contact`, by a simulation on the vehicle model (`contact_check.py`)."""
        distance, speed = contact_error(source, self)
        if not (distance <= CONTACT_MISS and speed <= CONTACT_SPEED_MISS):
            raise TrajectoryRefused(f"on its model the geometric law misses the contact by {100 * distance:.1f} cm and {speed:.2f} m/s: "
                                    "the rotors cannot follow this plan; the NMPC (controller.type: nmpc) may fly it")

    def end_on_model(self, start: np.ndarray, rotors: RotorEstimate, table: np.ndarray) -> np.ndarray:
        """Simulate a contact trajectory with this controller on its vehicle model.

        Args:
            start: state at the beginning, shape (13,).
            rotors: rotors at the beginning.
            table: setpoints `lag` ahead of each period until the contact, shape (n, 33).

        Returns:
            State at the contact, shape (13,).
        """
        return simulate(tuple(start.tolist()), rotors.speed, table, self._gains, self._limits(self._cone), self._settling,
                        self.gains.lead, self.lag, self.period, self._vehicle)
