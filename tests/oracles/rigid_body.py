"""Rigid-body dynamics in plain numpy, against which the compiled models of controllers, planner and simulator are held."""

from __future__ import annotations

import numpy as np

from perch_core.vehicle import GRAVITY, Vehicle


def accelerations(vehicle: Vehicle, R_WB: np.ndarray, w_WB_B: np.ndarray, rotor_thrust: np.ndarray,
                  f_drag_B: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Newton and Euler for the vehicle. [M:eq1, P:eq1]

    Args:
        vehicle: mass, inertia and rotor geometry.
        R_WB: attitude, shape (3, 3).
        w_WB_B: angular velocity in B [rad/s], shape (3,).
        rotor_thrust: thrust of each rotor [N], shape (4,).
        f_drag_B: further force in B [N], shape (3,), none by default.

    Returns:
        Acceleration in W [m/s^2] and angular acceleration in B [rad/s^2], shapes (3,).
    """
    wrench = vehicle.allocation @ np.asarray(rotor_thrust, float)
    f_B = np.array([0.0, 0.0, wrench[0]])
    if f_drag_B is not None:
        f_B = f_B + f_drag_B
    a_W = R_WB @ f_B / vehicle.mass - np.array([0.0, 0.0, GRAVITY])
    J = vehicle.inertia_matrix
    dw_B = np.linalg.solve(J, wrench[1:] - np.cross(w_WB_B, J @ w_WB_B))
    return a_W, dw_B
