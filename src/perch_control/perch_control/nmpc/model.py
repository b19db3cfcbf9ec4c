"""One stage of the predictive controller as a CasADi function: dynamics, their Jacobians, Gauss-Newton cost. [P:VI, P:eq1]

With 13 states the rotor thrusts are the inputs: an input is the thrust at the node, and may change over the interval as the
reference's thrusts do. With 17 states the thrusts are states and their rates are the inputs (`perch_core.rotor_model`). Rotor
drag and a constant disturbance (force and moment, from the L1 augmentation) are added to the rotor model. The optional line terms
are those of the powerline planner (`perch_core.lines`).
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from perch_core import lines, rotor_model
from perch_core.components import Vector, dot, rotate, rotate_back
from perch_core.rotor_model import P, Q, STATES, THRUST, V, W, RotorModel
from perch_core.so3 import quat_from_matrix
from perch_core.vehicle import Vehicle

INPUTS = 4
REFERENCE = 17      # p, q, v, w wanted at the node, and rotor thrusts there (17 states) or their change to the next node (13)
DISTURBANCE = 6     # acceleration in W [m/s^2], angular acceleration in B [rad/s^2]
WEIGHTS = 13        # position 3, velocity 3, attitude 3, rate 3, thrust
LINE = 8            # centre 3, direction 3, half length, radius
LINES = 3
LINE_PARAMETERS = LINES * LINE + 4  # and the weights: perception, visibility, collision, margin
_SMOOTH = 1e-3      # rounding of the hinges


@dataclass(frozen=True)
class StageLayout:
    """Size of a stage function's argument (x, u, reference, disturbance, weights[, lines])."""

    states: int
    with_lines: bool

    @property
    def arguments(self) -> int:
        """Length of the argument vector."""
        return self.states + INPUTS + REFERENCE + DISTURBANCE + WEIGHTS + (LINE_PARAMETERS if self.with_lines else 0)


def _rate(model: RotorModel, drag: Vector, x: Vector, u: Vector, disturbance: Vector, thrust_states: bool) -> Vector:
    """Time derivative of the state. [P:eq1]"""
    full = x if thrust_states else (*x, *u)
    rate = list(rotor_model.derivative(model, full, u if thrust_states else (0.0,) * INPUTS))
    v_B = rotate_back(x[Q], x[V])
    f_W = rotate(x[Q], tuple(-d / model.mass * v for d, v in zip(drag, v_B, strict=True)))
    for i in range(3):
        rate[7 + i] = rate[7 + i] + f_W[i] + disturbance[i]
        rate[10 + i] = rate[10 + i] + disturbance[3 + i]
    return tuple(rate[:STATES] if thrust_states else rate[:13])


def _rk4(f, x: Vector, step: float) -> Vector:
    """One Runge-Kutta step of x' = f(x, fraction of the step)."""
    def moved(k: Vector, h: float) -> Vector:
        return tuple(a + h * b for a, b in zip(x, k, strict=True))

    k1 = f(x, 0.0)
    k2 = f(moved(k1, step / 2), 0.5)
    k3 = f(moved(k2, step / 2), 0.5)
    k4 = f(moved(k3, step), 1.0)
    return tuple(a + step / 6 * (b + 2 * c + 2 * d + e) for a, b, c, d, e in zip(x, k1, k2, k3, k4, strict=True))


def _attitude_residual(q: Vector, r: Vector) -> Vector:
    """2 vec(r^-1 q) with the sign of the shorter rotation: the attitude error in B for small angles [rad]."""
    x, y, z, w = (-r[0], -r[1], -r[2], r[3])
    e = (
        w * q[0] + q[3] * x + y * q[2] - z * q[1],
        w * q[1] + q[3] * y + z * q[0] - x * q[2],
        w * q[2] + q[3] * z + x * q[1] - y * q[0],
    )
    side = ca.if_else(w * q[3] - x * q[0] - y * q[1] - z * q[2] >= 0, 2.0, -2.0)
    return tuple(side * c for c in e)


def _hinge(value):
    """Smooth `max(0, -value)`."""
    return 0.5 * (ca.sqrt(value * value + _SMOOTH) - value)


def _line_residuals(vehicle: Vehicle, x: Vector, parameters: Vector) -> list:
    """Soft terms of the powerlines: the first one is kept in view, all are kept at a distance. [P:eq7, P:eq9, P:eq12, P:eq13]"""
    perception, visibility, collision, margin = parameters[LINES * LINE:]
    p, q = x[P], x[Q]
    first = parameters[0:LINE]
    out = []
    mount = vehicle.mounts.get("front")
    if mount is not None:
        q_BC = tuple(float(v) for v in quat_from_matrix(mount.R_BC))
        o_C, l_C = lines.line_in_camera(p, q, first[0:3], first[3:6], tuple(map(float, mount.p_BC)), q_BC)
        n_I, l_I = lines.image_line(o_C, l_C)
        # [P:eq9] with the root kept away from zero: its gradient has no value where the camera looks along the line.
        out.append(ca.sqrt(perception) * n_I[2] / ca.sqrt(n_I[0] ** 2 + n_I[1] ** 2 + 1e-6))
        size = ca.sqrt(dot(n_I, n_I) + 1e-6)
        out.append(ca.sqrt(visibility) * _hinge(lines.cheirality(n_I, l_I) / size))
        beyond, reach = (first[6] * value for value in lines.segment_place(n_I, l_I, o_C, first[6]))
        beyond, reach = beyond * beyond, reach * reach
        out.append(ca.sqrt(visibility) * _hinge((reach - beyond) / (reach + beyond + 1e-6)))
    for k in range(LINES):
        o, l, half, radius = (parameters[LINE * k:LINE * k + 3], parameters[LINE * k + 3:LINE * k + 6],
                              parameters[LINE * k + 6], parameters[LINE * k + 7])
        clearance = lines.segment_clearance(p, q, o, l, half, radius, tuple(map(float, vehicle.body_radii)))
        scale = 1.0 / (min(vehicle.body_radii) + 0.03) ** 2
        out.append(ca.sqrt(collision) * _hinge(clearance / scale - margin))
    return out


def stage(vehicle: Vehicle, step: float, layout: StageLayout) -> ca.Function:
    """Build the stage function of a vehicle: from one vector (see `StageLayout`) to the next state, its Jacobians A and B, and
    the Hessian Q and gradient q of the Gauss-Newton cost.

    Args:
        vehicle: its parameters become constants of the code.
        step: length of a shooting interval [s].
        layout: 13 or 17 states, with or without lines.
    """
    n = layout.states
    z = ca.SX.sym("z", layout.arguments)
    cuts = [n, INPUTS, REFERENCE, DISTURBANCE, WEIGHTS, LINE_PARAMETERS if layout.with_lines else 0]
    parts, k = [], 0
    for size in cuts:
        parts.append(tuple(z[k + i] for i in range(size)))
        k += size
    x, u, reference, disturbance, weights, line_parameters = parts
    model, thrust_states = RotorModel.of(vehicle), n == STATES
    drag = tuple(float(d) for d in vehicle.drag)
    change: Vector = (0.0,) * INPUTS if thrust_states else reference[13:17]

    def rate(s: Vector, share: float) -> Vector:
        return _rate(model, drag, s, tuple(a + share * b for a, b in zip(u, change, strict=True)), disturbance, thrust_states)

    following = ca.vertcat(*_rk4(rate, x, step))
    w = tuple(ca.sqrt(value) for value in weights)
    residuals = [w[i] * (x[i] - reference[i]) for i in range(3)]
    residuals += [w[3 + i] * (x[7 + i] - reference[7 + i]) for i in range(3)]
    residuals += [w[6 + i] * e for i, e in enumerate(_attitude_residual(x[Q], reference[Q]))]
    residuals += [w[9 + i] * (x[W][i] - reference[10 + i]) for i in range(3)]
    if thrust_states:
        residuals += [w[12] * (x[THRUST][i] - reference[13 + i]) for i in range(4)]
    if layout.with_lines:
        residuals += _line_residuals(vehicle, x, line_parameters)
    r = ca.vertcat(*residuals)
    state, control = z[:n], z[n:n + INPUTS]
    J = ca.jacobian(r, state)
    A, B = ca.densify(ca.jacobian(following, state)), ca.densify(ca.jacobian(following, control))
    Q_gn = ca.densify(ca.mtimes(J.T, J))
    out = [ca.densify(e) for e in (following, A, B, Q_gn, ca.mtimes(J.T, r))]
    return ca.Function(f"stage{n}{'l' if layout.with_lines else ''}", [z], out)
