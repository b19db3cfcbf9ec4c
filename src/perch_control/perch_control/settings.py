"""Gains and limits of the controller, declared once for files, ROS parameters and documentation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from perch_core.config import quantity

Vector3 = tuple[float, float, float]


@dataclass(frozen=True)
class GeometricGains:
    """Gains of [M:eq2] per unit of mass and inertia, so that they carry over between vehicles: k_x = m position,
    k_v = m velocity, k_R = J attitude, k_Omega = J rate."""

    position: Vector3 = quantity((7.0, 7.0, 9.0), unit="1/s^2", low=0.0, high=200.0, doc="axes of W")
    velocity: Vector3 = quantity((4.5, 4.5, 5.5), unit="1/s", low=0.0, high=100.0, doc="axes of W")
    attitude: Vector3 = quantity((420.0, 420.0, 60.0), unit="1/s^2", low=0.0, high=5000.0, doc="axes of B")
    rate: Vector3 = quantity((32.0, 32.0, 10.0), unit="1/s", low=0.0, high=500.0, doc="axes of B")
    lead: float = quantity(0.02, unit="s", low=0.002, high=0.2, doc="time in which the rotors reach the wanted thrust")
    feedback_max: ClassVar[float] = 8.0      # bound of the position feedback [m/s^2]
    cone_deg: ClassVar[float] = 40.0         # the feedback turns the thrust no further from the reference's ...
    cone_contact_deg: ClassVar[float] = 5.0  # ... and no further than this at the end of a trajectory that ends in contact, to which ...
    contact_window: ClassVar[float] = 0.3    # ... the cone narrows over so long before it [s]
    thrust_floor: ClassVar[float] = 0.8      # specific thrust below which a direction is noise [m/s^2]
    acceleration_max: ClassVar[float] = 250.0  # bound of the commanded angular acceleration [rad/s^2]
    feedback_rate: float = quantity(0.0, unit="-", low=0.0, high=1.0, doc="share of the feedback's own derivative in the commanded rates")
    rehearse: bool = quantity(True, doc="fly a contact trajectory on the model first, and offset it so that it ends as planned")
    contact_speed: float = quantity(0.65, unit="m/s", low=0.0, high=2.0, doc="least speed into the surface that the rehearsal aims at")
    contact_overshoot: float = quantity(0.02, unit="m", low=0.0, high=0.2, doc="the rehearsal aims so far behind the surface")
