"""What a control law is: the base of all of them."""

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
    """What a controller answers in one period.

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

    Only `control` must be written. The supervisor, the references and what is known of the rotors are the same for all laws.

    Attributes:
        name: as in the parameter `controller.type` and the service `set_controller`.
        slow: building it takes seconds; it is built beside the flight.
        vehicle: as believed.
        period: of the odometry [s].
    """

    name: ClassVar[str]
    slow: ClassVar[bool] = False

    def __init__(self, vehicle: Vehicle) -> None:
        self.vehicle, self.period = vehicle, NOMINAL_PERIOD

    @classmethod
    def build(cls, vehicle: Vehicle, params: ControllerParameters) -> Law:
        """The law for a vehicle, with the controller's parameters.

        Raises:
            PerchError: it cannot be built with these.
        """
        return cls(vehicle)

    def retuned(self, params: ControllerParameters) -> Law | None:
        """Take new parameters in flight: itself with these; None: it is to be built anew.

        Raises:
            ConfigError: one of them is fixed after the start; nothing has changed.
        """
        return None

    def begin(self) -> None:
        """The law takes over: what it remembers of an earlier flight does not count."""

    def believe(self, vehicle: Vehicle) -> None:
        """Fly a vehicle whose thrust differs from what its file says."""
        self.vehicle = vehicle

    def pace(self, period: float) -> None:
        """Odometry comes with another period [s] from now on."""
        self.period = period

    def lines(self, lines: tuple[tuple[float, ...], ...]) -> None:
        """Powerlines to look at and to keep away from: (centre, direction, half length, radius), 8 floats each, the watched one first."""

    def check_contact(self, source: Source) -> None:
        """Refuse a trajectory to a contact that this law cannot follow with this vehicle.

        Raises:
            TrajectoryRefused: with how it would end.
        """

    @abstractmethod
    def control(self, state: tuple[float, ...], reference: Following, rotors: RotorEstimate,
                compensation: tuple[float, ...] = NO_COMPENSATION, time_to_contact: float = float("inf")) -> ControlOutput:
        """Rotor commands for one period.

        Args:
            state: p_WB [m], v_WB [m/s] in W, q_WB xyzw, w_WB_B [rad/s], 13 floats.
            reference: the running reference; `reference.setpoint(ahead)` is what is wanted `ahead` seconds from now.
            rotors: rotor speeds and what they are following.
            compensation: acceleration in W and angular acceleration in B that make up for disturbances, 6 floats.
            time_to_contact: to the planned contact [s], infinite where there is none.
        """
