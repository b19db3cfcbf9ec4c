"""Base class of the control laws."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, ClassVar, NamedTuple

from perch_core.vehicle import Vehicle
from perch_control.period import NOMINAL_PERIOD
from perch_control.rotor_lag import RotorEstimate

if TYPE_CHECKING:
    from perch_control.parameters import ControllerParameters
    from perch_control.reference import Following, Source

NO_COMPENSATION = (0.0,) * 6


class ControlOutput(NamedTuple):
    """Output of a control law for one period.

    Attributes:
        rotor_speed: commanded speeds [rad/s], 4 floats.
        wrench: wanted collective thrust [N] and moments in B [N m], 4 floats.
        rotor_thrust: thrusts that the rotors will have after the lead time [N], 4 floats.
        q_C: commanded attitude xyzw, 4 floats.
        w_C: commanded body rates in B [rad/s], 3 floats.
        dw_C: commanded angular acceleration in B [rad/s^2], 3 floats.
    """

    rotor_speed: tuple[float, ...]
    wrench: tuple[float, ...]
    rotor_thrust: tuple[float, ...]
    q_C: tuple[float, ...]
    w_C: tuple[float, ...]
    dw_C: tuple[float, ...]


class Law(ABC):
    """A control law: state and reference in, rotor commands out, once per odometry sample.

    Only `control` must be implemented. Supervisor, references and rotor estimate are the same for all laws.

    Attributes:
        name: as in the parameter `controller.type` and the service `set_controller`.
        slow: whether building it takes seconds; it is then built in the background.
        vehicle: the vehicle model in use.
        period: period of the odometry [s].
        failures: steps in which it has fallen back to another law.
    """

    name: ClassVar[str]
    slow: ClassVar[bool] = False
    failures: int = 0

    def __init__(self, vehicle: Vehicle) -> None:
        self.vehicle, self.period = vehicle, NOMINAL_PERIOD

    @classmethod
    def build(cls, vehicle: Vehicle, params: ControllerParameters) -> Law:
        """Build the law for a vehicle, with the controller's parameters.

        Raises:
            PerchError: the law cannot be built with these.
        """
        return cls(vehicle)

    def retuned(self, params: ControllerParameters) -> Law | None:
        """Apply new parameters in flight; return the law with these, or None where it must be rebuilt.

        A slow law that must be rebuilt refuses new parameters where it is in use in flight.

        Raises:
            ConfigError: one of them is fixed after the start; the law is unchanged.
        """
        return None

    def begin(self) -> None:
        """Take over control: reset the internal state of an earlier use."""

    def set_vehicle(self, vehicle: Vehicle) -> None:
        """Use a vehicle model whose thrust differs from that of the vehicle file."""
        self.vehicle = vehicle

    def set_period(self, period: float) -> None:
        """Use another period of the odometry [s] from the next step on."""
        self.period = period

    def lines(self, lines: tuple[tuple[float, ...], ...]) -> None:
        """Set the powerlines to avoid: (centre, direction, half length, radius), 8 floats each; the first is kept in view too."""

    def check_contact(self, source: Source) -> None:
        """Refuse a trajectory to a contact that this law cannot follow with this vehicle.

        Raises:
            TrajectoryRefused: with the predicted miss of the contact.
        """

    @abstractmethod
    def control(self, state: tuple[float, ...], reference: Following, rotors: RotorEstimate,
                compensation: tuple[float, ...] = NO_COMPENSATION, time_to_contact: float = float("inf")) -> ControlOutput:
        """Rotor commands for one period.

        Args:
            state: p_WB [m], v_WB [m/s] in W, q_WB xyzw, w_WB_B [rad/s], 13 floats.
            reference: the running reference; `reference.setpoint(ahead)` is the setpoint `ahead` seconds from now.
            rotors: rotor speeds and their commands.
            compensation: acceleration in W and angular acceleration in B that compensate for disturbances, 6 floats.
            time_to_contact: time to the planned contact [s], infinite where there is none.
        """
