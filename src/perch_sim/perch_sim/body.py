"""Parameters of the simulated vehicle's body, as the kernels take them: mass, rotors, and contact points."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from perch_core.errors import ConfigError
from perch_core.vehicle import Vehicle
from perch_sim.scenario import Disturbance

PLATE_POINTS = 8  # on the rim of the velcro plate
TIP_POINTS = 8    # on the rim of each rotor disc

# The plate's felt and the propellers' tips as springs. 250 N/m per point lets 0.25 kg sink 1.2 mm at rest.
PLATE_STIFFNESS = 2000.0  # all points together [N/m]
TIP_STIFFNESS = 400.0     # one point [N/m]
DAMPING_RATIO = 0.3       # of the vertical bounce on the plate
FRICTION = 0.6            # Coulomb coefficient
HOLD_FREQUENCY = 100.0    # of the vehicle on the velcro's felt [rad/s]
HOLD_DAMPING_RATIO = 0.6


class Body(NamedTuple):
    """Constants of the dynamics. SI units; axes of B."""

    mass: float
    inertia: np.ndarray             # principal moments, (3,)
    rotor_xy: np.ndarray            # (4, 2)
    yaw_arm: np.ndarray             # drag torque per thrust, signed, (4,) [m]
    thrust_coefficient: np.ndarray  # (4,) [N s^2/rad^2]
    time_constant: float            # of the rotor speed [s]
    speed_min: float                # [rad/s]
    speed_max: float                # [rad/s]
    rotor_radius: float             # [m]
    drag: np.ndarray                # linear, (3,) [N s/m]
    surface_effect: bool
    imu_position: np.ndarray        # p_BI, (3,)
    points: np.ndarray              # contact points, (n, 3); the first PLATE_POINTS are the velcro plate's rim
    stiffness: np.ndarray           # (n,) [N/m]
    damping: np.ndarray             # (n,) [N s/m]
    friction: float
    reach: float                    # no contact point is further from the centre of mass [m]
    plate_offset: float             # plate below the centre of mass [m]
    hold: np.ndarray                # stiffness and damping of an attached plate: [N/m, N s/m, N m/rad, N m s/rad]


def hold_rate(body: Body) -> float:
    """Return the greatest rate at which the hold damps a motion [1/s]: of the plate at its arm, or of a turn."""
    rates = body.hold[3] / body.inertia
    rates[:2] += body.hold[1] * (1.0 / body.mass + body.plate_offset**2 / body.inertia[:2])
    return float(rates.max())


def _contact_points(vehicle: Vehicle) -> np.ndarray:
    """Return the contact points in B: rim of the plate, then rims of the rotor discs, then the top, (n, 3)."""
    def ring(count: int, radius: float, centre: np.ndarray) -> np.ndarray:
        angle = 2 * np.pi * (np.arange(count) + 0.5) / count
        return centre + radius * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)

    plate = ring(PLATE_POINTS, vehicle.perch_radius, np.array([0.0, 0.0, -vehicle.perch_offset]))
    tips = [ring(TIP_POINTS, vehicle.propeller_radius, np.array([*xy, 0.0])) for xy in vehicle.rotor_xy]
    top = np.array([[0.0, 0.0, vehicle.body_radii[2]]])
    return np.concatenate([plate, *tips, top])


def make_body(vehicle: Vehicle, disturbance: Disturbance = Disturbance()) -> Body:
    """Return the true body of a vehicle.

    Args:
        vehicle: vehicle as its file describes it.
        disturbance: differences of the true vehicle from its file.

    Raises:
        ConfigError: a surface effect on a vehicle whose propellers have no radius.
    """
    if disturbance.surface_effect and vehicle.propeller_radius == 0.0:
        raise ConfigError("", "disturbance.surface_effect", f"needs the propeller_radius of {vehicle.name}, which its file does not set")
    mass = vehicle.mass * disturbance.mass_factor
    inertia = np.array(vehicle.inertia) * disturbance.inertia_factor
    points = _contact_points(vehicle)
    stiffness = np.full(len(points), TIP_STIFFNESS)
    stiffness[:PLATE_POINTS] = PLATE_STIFFNESS / PLATE_POINTS
    damping = np.full(len(points), 2 * DAMPING_RATIO * np.sqrt(TIP_STIFFNESS * mass))
    damping[:PLATE_POINTS] = 2 * DAMPING_RATIO * np.sqrt(PLATE_STIFFNESS * mass) / PLATE_POINTS
    turn = float(inertia.mean()) * HOLD_FREQUENCY
    return Body(
        mass=float(mass), inertia=inertia, rotor_xy=np.array(vehicle.rotor_xy, float),
        yaw_arm=vehicle.torque_ratio * np.array(vehicle.rotor_yaw_sign, float),
        thrust_coefficient=vehicle.thrust_coefficient * np.array(disturbance.rotor_thrust_factor, float),
        time_constant=float(vehicle.motor_time_constant * disturbance.motor_lag_factor),
        speed_min=float(vehicle.speed_min), speed_max=float(vehicle.speed_max),
        rotor_radius=float(vehicle.propeller_radius), drag=np.array(vehicle.drag, float),
        surface_effect=bool(disturbance.surface_effect), imu_position=np.array(vehicle.imu.position, float),
        points=points, stiffness=stiffness, damping=damping, friction=FRICTION,
        reach=float(np.linalg.norm(points, axis=1).max()), plate_offset=float(vehicle.perch_offset),
        hold=np.array([mass * HOLD_FREQUENCY**2, 2 * HOLD_DAMPING_RATIO * mass * HOLD_FREQUENCY,
                       turn * HOLD_FREQUENCY, 2 * HOLD_DAMPING_RATIO * turn]),
    )
