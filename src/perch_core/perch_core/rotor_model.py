"""Quadrotor model with the rotor thrusts as states: 17 states, thrust rates as inputs. [P:eq1, P:eq2]

State, in this order: p_WB (3) [m], q_WB (4, xyzw), v_WB (3) [m/s], w_WB_B (3) [rad/s], rotor thrusts gamma (4) [N].
Input: u = d gamma / dt (4) [N/s]. Every function is generic over numbers, arrays (one vector per entry) and CasADi
symbols; see `components`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from perch_core.arrays import vector3
from perch_core.components import Scalar, Vector, components, dot, matrix_of, stack
from perch_core.vehicle import GRAVITY, Vehicle

STATES = 17
INPUTS = 4
P, Q, V, W, THRUST = slice(0, 3), slice(3, 7), slice(7, 10), slice(10, 13), slice(13, 17)


@dataclass(frozen=True)
class RotorModel:
    """Constants of the model.

    Attributes:
        mass: [kg].
        inertia: principal moments about the axes of B [kg m^2], 3 values.
        torque: rows of M, rotor thrusts -> torque in B [m], 3 x 4. [P:eq2]
        gravity: [m/s^2].
    """

    mass: float
    inertia: tuple[float, float, float]
    torque: tuple[tuple[float, ...], ...]
    gravity: float = GRAVITY

    @classmethod
    def of(cls, vehicle: Vehicle, gravity: float = GRAVITY) -> RotorModel:
        """Return the model of a vehicle; its allocation matrix without the first row is M of [P:eq2]."""
        torque = tuple(tuple(float(x) for x in row) for row in vehicle.allocation[1:])
        return cls(float(vehicle.mass), vector3(vehicle.inertia), torque, float(gravity))

    @property
    def hover(self) -> float:
        """Thrust of one rotor in hover [N]."""
        return self.mass * self.gravity / 4


def derivative(model: RotorModel, x: Vector, u: Vector) -> Vector:
    """Time derivative of the state. [defines M:eq1, P:eq1]

    Args:
        model: constants.
        x: state, 17 components.
        u: thrust rates [N/s], 4 components.

    Returns:
        17 components, units of the state per second.
    """
    qx, qy, qz, qw = x[Q]
    wx, wy, wz = x[W]
    Jx, Jy, Jz = model.inertia
    gamma = x[THRUST]
    specific_thrust = (gamma[0] + gamma[1] + gamma[2] + gamma[3]) / model.mass
    b3_W = tuple(row[2] for row in matrix_of(x[Q]))
    Mx, My, Mz = (dot(row, gamma) for row in model.torque)
    dq = (  # q (.) (w, 0) / 2
        0.5 * (wx * qw + wz * qy - wy * qz),
        0.5 * (wy * qw - wz * qx + wx * qz),
        0.5 * (wz * qw + wy * qx - wx * qy),
        0.5 * (-wx * qx - wy * qy - wz * qz),
    )
    dv = (b3_W[0] * specific_thrust, b3_W[1] * specific_thrust, b3_W[2] * specific_thrust - model.gravity)
    dw = (
        (Mx - (Jz - Jy) * wy * wz) / Jx,
        (My - (Jx - Jz) * wz * wx) / Jy,
        (Mz - (Jy - Jx) * wx * wy) / Jz,
    )
    return (*x[V], *dq, *dv, *dw, *u)


def rk4(model: RotorModel, x: Vector, u: Vector, step: Scalar) -> Vector:
    """One Runge-Kutta step with constant input. [P:eq14d]

    Args:
        model: constants.
        x: state, 17 components.
        u: thrust rates [N/s], 4 components.
        step: duration [s].

    Returns:
        State after `step`; its quaternion is not normalised.
    """
    def moved(factor: Scalar, k: Vector) -> Vector:
        return tuple(xi + factor * ki for xi, ki in zip(x, k, strict=True))

    k1 = derivative(model, x, u)
    k2 = derivative(model, moved(step / 2, k1), u)
    k3 = derivative(model, moved(step / 2, k2), u)
    k4 = derivative(model, moved(step, k3), u)
    return tuple(xi + step / 6 * (a + 2 * b + 2 * c + d) for xi, a, b, c, d in zip(x, k1, k2, k3, k4, strict=True))


def accelerations(model: RotorModel, states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Accelerations along a sampled trajectory. [P:eq1]

    Args:
        model: constants.
        states: shape (n, 17).

    Returns:
        Acceleration in W [m/s^2] and angular acceleration in B [rad/s^2], shapes (n, 3).
    """
    rate = derivative(model, components(np.asarray(states, float)), (0.0,) * INPUTS)
    return stack(rate[V]), stack(rate[W])


def hover_state(model: RotorModel, p_WB: np.ndarray, q_WB: np.ndarray) -> np.ndarray:
    """State at rest with the rotors carrying the weight, shape (17,); `q_WB` is normalised."""
    q_WB = np.asarray(q_WB, float)
    state = np.zeros(STATES)
    state[P], state[Q] = p_WB, q_WB / np.linalg.norm(q_WB)
    state[THRUST] = model.hover
    return state
